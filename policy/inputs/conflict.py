"""Vehicles along an AV's lanes, and its conflict with a mission vehicle: geometry on the road map."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.geometry.compiled import compiled
from cosim.road import LanePath, RoadMap
from cosim.types import IS_MISSION, Bools, Floats, Floats32, History, Ints

LANE_WIDTH = 3.2  # m, SUMO's default
CAR_LENGTH = 5.0  # m, SUMO's default passenger car
LEFT, RIGHT = 0, 2  # of `RouteAhead.paths`
MIN_CLEAR_GAP = 10.0  # m, a free lane: space ahead and behind,
CLEAR_TIME_GAP = 0.8  # s, plus this time gap to the follower,
MAX_CLOSING_SPEED = 3.0  # m/s, largest speed of a follower above the AV's,
CLOSING_TIME = 3.0  # s of closing speed added to the space
LEAST_LANE = 100.0  # m to the lane's dead end


class Seen(NamedTuple):
    """The mission vehicle as perceived by one AV and shared with the others."""

    lane: int  # index into RoadMap.lanes
    lane_position: float  # m, front bumper
    speed: float  # m/s


@dataclass(frozen=True, slots=True)
class Conflict:
    """An AV's conflict with a mission vehicle: their paths cross or run into adjacent lanes."""

    behind: float  # m, the AV's lag behind the mission vehicle at the conflict point
    crossing: bool  # their paths cross at a junction (else their lanes are adjacent)
    from_right: bool  # the mission vehicle's lane lies to the right
    speed: float  # m/s, of the mission vehicle


def missions(histories: Iterable[History]) -> dict[str, Seen]:
    """Every mission vehicle that any of these AVs perceives (V2V: some AVs are out of range)."""
    return {
        h.ids[r]: Seen(int(h.lane[r]), float(h.lane_position[r]), float(h.kinematics[-1, r, 2]))
        for h in histories
        for r in np.flatnonzero(h.valid[-1] & (h.kinematics[-1, :, IS_MISSION] > 0.5))
    }


def find_conflict(road: RoadMap, history: History, seen: Seen) -> Conflict | None:
    """This AV's conflict with the mission vehicle; None without a conflict."""
    own = history.route.paths[1]
    if own is None or seen.lane < 0:
        return None
    theirs = road.path(seen.lane)
    place = seen.lane_position * theirs.scale  # m, the mission vehicle's front bumper
    adjacent = beside(road, own, theirs)
    if adjacent is not None:
        mine, other, right = adjacent
        return Conflict((mine - history.route.arc) - (other - place), False, right, seen.speed)
    if not (np.isfinite(own.conflict) and _crosses_junction(road, theirs)):
        return None  # no conflict: the ego's lane is adjacent to the mission vehicle's target lane
    if _same_approach(road, own, theirs):
        return None
    behind = history.route.conflict_distance - max(theirs.conflict - place, 0.0)
    return Conflict(behind, True, False, seen.speed)


def along(history: History, path: LanePath, side: float = 0.0) -> Floats:
    """Vehicles on the path's next lanes, or behind on its course [k,2]: m ahead of the ego (centres), m/s.

    Upstream lanes have other indices, so vehicles behind are matched by position: `side` m to the left.
    """
    return _along(history.kinematics[-1], history.valid[-1], history.lane, path.next_lanes, side)


def is_free(history: History, side: int) -> bool:
    """Whether the lane on this side (`LEFT`, `RIGHT`) has no near leader, no one beside, no fast follower."""
    speed = history.ego_speed
    path = history.route.paths[side]
    if path is None or history.route.to_end(side) < LEAST_LANE or history.lane_changing:
        return False
    for ahead, other in along(history, path, side=LANE_WIDTH if side == LEFT else -LANE_WIDTH):
        if ahead < 0.0 and other - speed > MAX_CLOSING_SPEED:
            return False  # an AV that has slowed down already stays in its lane
        behind = MIN_CLEAR_GAP + other * CLEAR_TIME_GAP + max(other - speed, 0.0) * CLOSING_TIME
        front = MIN_CLEAR_GAP + max(speed - other, 0.0) * CLOSING_TIME
        if -behind < ahead < front:
            return False
    return True


@compiled
def _along(newest: Floats32, valid: Bools, lane: npt.NDArray[np.int32], lanes: Ints, side: float) -> Floats:
    out = np.empty((len(valid), 2))
    count = 0
    for r in range(1, len(valid)):
        if not valid[r]:
            continue
        on = newest[r, 0] < 0.0 and abs(newest[r, 1] - side) < 0.5 * LANE_WIDTH
        for one in lanes:
            on = on or lane[r] == one
        if on:
            out[count, 0], out[count, 1] = newest[r, 0], newest[r, 2]
            count += 1
    return out[:count]


def _crosses_junction(road: RoadMap, path: LanePath) -> bool:
    """Whether the path's conflict zone lies inside a junction."""
    return any(road.lanes[i].internal and any(i in zone.lanes for zone in road.zones) for i in path.lanes)


def _same_approach(road: RoadMap, own: LanePath, theirs: LanePath) -> bool:
    """Whether both paths use the same edge on different lanes."""
    edges = {road.lanes[i].edge for i in own.lanes if not road.lanes[i].internal}
    return road.lanes[theirs.lanes[0]].edge in edges


def beside(road: RoadMap, own: LanePath, theirs: LanePath) -> tuple[float, float, bool] | None:
    """Where the other lane becomes adjacent: arc on the own path, arc on the other, whether on the right."""
    place = {lane: float(start) for lane, start in zip(own.lanes, own.lane_start, strict=True)}
    for lane, start in zip(theirs.lanes, theirs.lane_start, strict=True):
        left, right = road.lanes[lane].left, road.lanes[lane].right
        if left in place:
            return place[left], float(start), True
        if right in place:
            return place[right], float(start), False
    return None
