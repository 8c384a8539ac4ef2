"""Gap acceptance of an AV after a long wait at a line where it must give way.

SUMO's driver gives way even to a standing vehicle with priority, often until the gap is over. Here a vehicle
that has stood for a while is taken to yield, and AVs with priority admit the waiting AV (V2V). All other
vehicles with priority must be far enough away not to brake.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from cosim.geometry import Boxes, overlap
from cosim.road import Link, RoadMap, Rule
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.foes import Foes
from cosim.simulation.lawful.inside import SPACING, Inside
from cosim.types import Floats

FOE_RANGE = 200.0  # m before its own line, within which a vehicle with priority counts
COMFORTABLE_DECEL = 1.2  # m/s2: an AV that can stop before its line with less counts as no foe
VISIBLE_NOSE = 0.5  # m beyond the line, at which others react to the AV
MAX_FOE_SPEED = 20.0  # m/s, the highest speed limit of a foe's road at which the AV sees the foe in time
START_DELAY_AND_ACCEL = 0.5, 2.0  # s and m/s2 of an AV that sets off
MOVING_ACCEL = 2.0  # m/s2 of a moving vehicle, up to its speed limit
MIN_CONFLICT_GAP = 1.5  # s between two vehicles passing the same conflict point
MERGE_DECEL = 1.5  # m/s2 by which a foe may slow down behind the merged AV
YIELD_BRAKING_DISTANCE = 25.0  # m before its own line, where a foe that must yield brakes
YIELDED_AFTER = 2.0  # s of standing, after which a vehicle with priority is taken to yield
ADMISSION_DECEL = 1.2  # m/s2 with which an admitting AV must be able to stop when the AV sets off
ADMISSION_HORIZON = 5.0  # s ahead, within which AVs are asked to admit the AV
STOP_RULES = (Rule.STOP, Rule.ALL_WAY_STOP)

Conflict = tuple[float, float, float]  # m from the lines: AV past the conflict; foe reaches it, leaves it


class Gaps:
    """Gap acceptance at the lines of `road`, as seen with `eyes`; `inside` gives the paths in junctions."""

    def __init__(self, road: RoadMap, inside: Inside, eyes: Eyes) -> None:
        self._road = road
        self._inside = inside
        self._eyes = eyes
        self._foes = Foes(road, FOE_RANGE, eyes)

    def accept(
        self, name: str, lane: str, via: str, admits: Callable[[str, float], bool | None]
    ) -> tuple[bool, list[str]]:
        """Whether `name`, which stands on `lane` before a line, can set off now over the internal lane
        `via`; and the AVs that must admit it, now or soon.

        Args:
            lane: may be internal: the place where vehicles wait inside the junction. Then `via` is ignored.
            admits: whether a vehicle, so many m before its line, admits others; None: it sets off itself.
        """
        road, get = self._road, self._eyes.view(name)
        own = road.index.get(lane, -1)
        link, into = self._link_ahead(own, road.index.get(via, -1))
        if link < 0 or self._left_to_sumo(name, link):
            return False, []
        line = road.lanes[own].length - sumo.vehicle.getLanePosition(name)  # m
        mine = self._inside.swept_path(name, into, 0.0)
        blocked: list[tuple[float, float]] = []  # (begin, end) of no entry, s from now
        admissions: list[tuple[float, str, bool]] = []  # begin in s, admitting AV, whether that AV can stop
        first: dict[int, float] = {}  # lane -> m before its line of a yielding vehicle, which blocks its lane
        for before, other, foe in self._foes_by_distance(link, name):
            if before is None:
                return False, []
            theirs, speed = road.links[foe], get.getSpeed(other)
            admitted = admits(other, before) if before > 0.0 else None
            has_yielded = admitted is not None and sumo.vehicle.getWaitingTime(other) > YIELDED_AFTER
            if before > first.get(theirs.origin, math.inf) and not _yields_ahead(theirs, before):
                continue
            conflict = self._conflict(mine, other, foe) if admitted or not has_yielded else None
            if has_yielded or (admitted and conflict is not None):
                first[theirs.origin] = min(before, first.get(theirs.origin, math.inf))
            if conflict is None:
                continue
            begin, end = self._blocked_interval(road.links[link], line, foe, conflict, before, speed)
            if admitted:
                admissions.append((begin, other, speed**2 <= 2.0 * ADMISSION_DECEL * max(before - 1.0, 0.0)))
            elif end > 0.0:
                blocked.append((begin, end))
        start = 0.0
        for begin, end in sorted(blocked):
            if begin < start < end:
                start = end
        asked = [(other, can_stop) for begin, other, can_stop in admissions if begin < start]
        if start > ADMISSION_HORIZON:
            return False, []
        return start == 0.0 and all(can_stop for _, can_stop in asked), [other for other, _ in asked]

    def braking(self, name: str, lane: str, via: str, step: float, is_foe: Callable[[str], bool]) -> float:
        """The hardest braking (m/s2) that `name` would impose on vehicles with priority, going on
        now from `lane` over the lane `via`.

        SUMO's drivers stop `minGap` before the place where the lanes meet.

        Args:
            lane, via: as of `accept`.
            step: s of a simulation step.
            is_foe: whether a vehicle counts."""
        road, get = self._road, self._eyes.view(name)
        own = road.index.get(lane, -1)
        link, into = self._link_ahead(own, road.index.get(via, -1))
        if link < 0 or not road.links[link].foes:
            return 0.0
        mine, hardest = None, 0.0
        distance = road.lanes[own].length - get.getLanePosition(name)
        arrival = _travel_time(distance + VISIBLE_NOSE, get.getSpeed(name), MOVING_ACCEL, MAX_FOE_SPEED)  # s
        for other, foe in self._foes.find(link, name):
            if road.links[foe].rule in STOP_RULES or not is_foe(other):  # the foe brakes anyway
                continue
            before, speed = self._to_line(other, foe, get), get.getSpeed(other)
            if before is None or before <= 0.0 or speed**2 <= 2.0 * COMFORTABLE_DECEL * before:
                continue
            if mine is None:
                mine = self._inside.swept_path(name, into, 0.0)
                mine[4] += 2.0 * (road.lanes[into].width - mine[4])  # both as wide as their lanes
            conflict = self._conflict(mine, other, foe)
            if conflict is not None:
                gap = max(before + conflict[1] - get.getMinGap(other) - arrival * speed, 0.1)
                hardest = max(hardest, (speed - get.getStopSpeed(other, speed, gap)) / step)
        return hardest

    # ---- inside ----

    def _link_ahead(self, own: int, via: int) -> tuple[int, int]:
        """The next link of a vehicle on lane `own`, over a line or from a waiting place inside a junction,
        and the lane that the vehicle enters; below 0 where there is none."""
        road = self._road
        if not road.waits_inside(own):
            return road.link_of.get((own, via), -1), via
        link = road.links_through[own][0]
        return link, road.lanes[own].successors[0]

    def _left_to_sumo(self, name: str, link: int) -> bool:
        """Whether SUMO's driver decides alone at `link`: at a signal, without a plain yield or stop rule,
        with foes too fast to be seen in time, or with persons at the junction. Only SUMO's driver checks its
        whole way for persons."""
        lanes, links = self._road.lanes, self._road.links
        if links[link].signal >= 0 or links[link].rule not in (Rule.YIELD, Rule.STOP):
            return True
        if any(lanes[links[foe].origin].speed_limit > MAX_FOE_SPEED for foe in links[link].foes):
            return True
        return any(True for _ in self._inside.persons(name, lanes[links[link].via].start, 0.0))

    def _foes_by_distance(self, link: int, name: str) -> Iterator[tuple[float | None, str, int]]:
        """The vehicles with priority over a link, nearest first: m before their line (below 0: beyond it;
        None: unknown), id, and link."""
        get = self._eyes.view(name)
        found = [(self._to_line(other, foe, get), other, foe) for other, foe in self._foes.find(link, name)]
        yield from sorted(found, key=lambda entry: -math.inf if entry[0] is None else entry[0])

    def _conflict(self, mine: Floats, other: str, foe: int) -> Conflict | None:
        """Where the path `mine` ([5,k], of `Inside.swept_path`) meets that of `other`; None: nowhere."""
        theirs = self._inside.swept_path(other, self._road.links[foe].via, 0.0)
        conflict = overlap(Boxes(*mine[:, :, None]), Boxes(*theirs[:, None, :]))  # [places, places]
        places, others = np.flatnonzero(conflict.any(1)), np.flatnonzero(conflict.any(0))
        if not len(places):
            return None
        return float(places[-1] + 1) * SPACING, float(others[0]) * SPACING, float(others[-1]) * SPACING

    def _blocked_interval(
        self, mine: Link, line: float, foe: int, conflict: Conflict, before: float, speed: float
    ) -> tuple[float, float]:
        """(begin, end) in s from now: a vehicle `line` m before its line cannot set off then, because of
        a foe at `speed` m/s, `before` m before the line of the link `foe`."""
        lanes, theirs = self._road.lanes, self._road.links[foe]
        clear, reach, leave = conflict
        (delay, accel), turn_speed = START_DELAY_AND_ACCEL, lanes[mine.via].speed_limit
        max_speed = max(speed, lanes[theirs.origin].speed_limit)
        if before > 0.0 and theirs.rule in STOP_RULES:
            arrival = before / max(speed, 0.1) + delay + _travel_time(reach, 0.0, MOVING_ACCEL, max_speed)
        elif _yields_ahead(theirs, before):
            arrival = _travel_time(before - YIELD_BRAKING_DISTANCE, speed, MOVING_ACCEL, max_speed)
        else:
            arrival = _travel_time(before + reach, speed, MOVING_ACCEL, max_speed)
        if theirs.target == mine.target:
            slower = max(max_speed - min(math.sqrt(2.0 * accel * (line + clear)), turn_speed), 0.0)  # m/s
            arrival -= slower**2 / (2.0 * MERGE_DECEL) / max_speed
        clearing = delay + _travel_time(line + clear, 0.0, accel, turn_speed)
        return arrival - clearing - MIN_CONFLICT_GAP, (before + leave) / max(speed, 1.0)

    def _to_line(self, name: str, foe: int, get: Any) -> float | None:
        """m from a vehicle to the line of the link `foe`; below 0: beyond it; None: unknown.

        `get`: of `Eyes.view`.
        """
        road = self._road
        lane, at = road.index.get(get.getLaneID(name), -1), get.getLanePosition(name)
        if lane < 0:
            return None
        beyond = 0.0
        for inside in road.inside[foe]:
            if inside == lane:
                return -float(beyond + at)
            beyond += road.lanes[inside].length
        away = float(road.lanes[lane].length - at)
        if get is not sumo.vehicle and road.lanes[lane].id != sumo.vehicle.getLaneID(name):
            return self._straight_on(lane, away, foe)  # SUMO's links are those of the true lane
        while road.lanes[lane].internal:  # `getNextLinks` starts at the end of the next normal lane
            lane = next(iter(road.lanes[lane].successors), -1)
            if lane < 0:
                return None
            away += road.lanes[lane].length
        for following, _, _, _, via, *_, length in get.getNextLinks(name):
            if via and road.index.get(via, -1) == road.links[foe].via:
                return away
            away += float(length + sumo.lane.getLength(following))
        return None

    def _straight_on(self, lane: int, away: float, foe: int) -> float | None:
        """`_to_line` of a vehicle `away` m before the end of `lane` that drives straight on."""
        following, length = self._road.straight_on
        while away < FOE_RANGE and (lane := int(following[lane])) >= 0:
            if lane == self._road.links[foe].via:
                return away
            away += float(length[lane])
        return None


def _yields_ahead(link: Link, before: float) -> bool:
    """Whether a vehicle `before` m before the line of `link` brakes there to give way, without a stop."""
    return before > 0.0 and bool(link.foes) and link.rule not in STOP_RULES


def _travel_time(distance: float, speed: float, accel: float, max_speed: float) -> float:
    """s to drive `distance` m from `speed` m/s at `accel` m/s2 up to `max_speed` m/s; 0 below 0 m."""
    distance, accel_distance = max(distance, 0.0), (max_speed**2 - speed**2) / (2.0 * accel)
    if distance <= accel_distance:
        return (math.sqrt(speed**2 + 2.0 * accel * distance) - speed) / accel
    return (max_speed - speed) / accel + (distance - accel_distance) / max_speed
