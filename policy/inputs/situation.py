"""An AV's situation in few numbers: its command, its lanes, the vehicles on them, and the mission vehicle.

Maps and kinematic rows contain nearly all of it, but a network does not extract it from the few episodes of
a training on two cores.
"""

from collections.abc import Sequence

import numpy as np

from cosim.control import SPEED_STEP
from cosim.geometry.compiled import compiled
from cosim.road import RoadMap
from cosim.types import Floats, Floats32, History
from policy.inputs.conflict import LANE_WIDTH, along, find_conflict, missions

LOOK_AHEAD = np.array([20.0, 50.0, 100.0])  # m, sample points of the candidate centre lines
MAX_DISTANCE = 200.0  # m, cap of the distance to lane ends and conflict zones
MAX_NEIGHBOUR_GAP = 100.0  # m, cap of the gap to neighbours
SPEED_SCALE = 30.0  # m/s
COMMAND = 7  # number of inputs before those of the lanes
PER_LANE = 3 + 2 * len(LOOK_AHEAD) + 4
MISSION_START = COMMAND + 3 * PER_LANE  # first of the six inputs of the mission vehicle
SITUATION_INPUTS = MISSION_START + 6


def situation(histories: Sequence[History], road: RoadMap, shared: bool) -> Floats32:
    """[B,SITUATION_INPUTS], scaled to about [-1, 1], of AVs that decide together.

    Command (7): target speed, speed limit, distance to the conflict zone, lane change under way, own
    speed, grid levels below the highest target, speed error. Then for the left, present and right lane:
    existence, dead end, distance to it, centre line at LOOK_AHEAD m (offset and direction in the ego
    frame), and gap and relative speed of the next vehicle ahead and behind. Then (6) the mission vehicle
    in conflict with the AV: existence, the AV's lag at the conflict point, the lag of the preceding AV,
    crossing, from the right, speed. `shared`: V2V, all AVs know the mission vehicles and the order of
    arrival.
    """
    met = _mission_inputs(histories, road, shared)
    each = [np.concatenate([_command_inputs(h), _lanes(h), m]) for h, m in zip(histories, met, strict=True)]
    return np.array(each, np.float32)


def _command_inputs(history: History) -> list[float]:
    route = history.route
    return [
        history.target_speed / SPEED_SCALE,
        route.speed_limit / SPEED_SCALE,
        min(route.conflict_distance, MAX_DISTANCE) / MAX_DISTANCE,
        float(history.lane_changing),
        history.ego_speed / SPEED_SCALE,
        min(max((route.speed_limit - history.target_speed) / SPEED_STEP, -1.0), 2.0),
        min(max((history.ego_speed - history.target_speed) / SPEED_STEP, -1.0), 1.0),
    ]


def _lanes(history: History) -> Floats:
    """[3*PER_LANE] of the left, present and right lane."""
    route = history.route
    out = np.zeros((3, PER_LANE))
    for side, path in enumerate(route.paths):
        if path is not None:
            course = (path.points, path.arc, route.arc + LOOK_AHEAD, history.pose)
            others = along(history, path, (1 - side) * LANE_WIDTH)
            end = min(route.to_end(side), MAX_DISTANCE) / MAX_DISTANCE
            _lane(*course, path.dead_end, end, others, history.ego_speed, out[side])
    return out.ravel()


@compiled
def _lane(
    points: Floats,
    arc: Floats,
    places: Floats,
    pose: Floats,
    dead_end: bool,
    end: float,
    others: Floats,
    speed: float,
    out: Floats,
) -> None:
    """One existing lane: its course at `places` m, and its next vehicles ahead and behind among `others`."""
    out[0], out[1], out[2] = 1.0, dead_end, end
    c, s = np.cos(pose[2]), np.sin(pose[2])
    count = len(places)
    for k in range(count):
        i = min(max(np.searchsorted(arc, places[k], side="right") - 1, 0), len(arc) - 2)
        dx, dy = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
        t = (places[k] - arc[i]) / max(arc[i + 1] - arc[i], 1e-9)
        left = c * (points[i, 1] + t * dy - pose[1]) - s * (points[i, 0] + t * dx - pose[0])
        out[3 + k] = left / 50.0
        out[3 + count + k] = ((np.arctan2(dy, dx) - pose[2] + np.pi) % (2 * np.pi) - np.pi) / np.pi
    at = 3 + 2 * count
    for direction in (1.0, -1.0):  # gap (centres) and relative speed; 1 and 0 without a vehicle
        gap, theirs = np.inf, speed
        for k in range(len(others)):
            if 0.0 < direction * others[k, 0] < gap:
                gap, theirs = direction * others[k, 0], others[k, 1]
        out[at], out[at + 1] = min(gap, MAX_NEIGHBOUR_GAP) / MAX_NEIGHBOUR_GAP, (theirs - speed) / SPEED_SCALE
        at += 2


def _mission_inputs(histories: Sequence[History], road: RoadMap, shared: bool) -> list[list[float]]:
    """Of every AV [6]: its nearest conflicting mission vehicle and the AV that arrives before it."""
    if not shared:
        return [_arrival_order([h], road)[0] for h in histories]
    return _arrival_order(histories, road)


def _arrival_order(histories: Sequence[History], road: RoadMap) -> list[list[float]]:
    absent = [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    seen = missions(histories).items()
    found = [{n: c for n, at in seen if (c := find_conflict(road, h, at)) is not None} for h in histories]
    out = []
    for mine in found:
        if not mine:
            out.append(absent)
            continue
        name, m = min(mine.items(), key=lambda item: abs(item[1].behind))
        before = [o[name].behind for o in found if name in o and o[name].behind < m.behind]
        next_before = max(before, default=-MAX_DISTANCE)
        out.append(
            [
                1.0,
                min(max(m.behind / MAX_DISTANCE, -1.0), 1.0),
                max(next_before / MAX_DISTANCE, -1.0),
                float(m.crossing),
                float(m.from_right),
                m.speed / SPEED_SCALE,
            ]
        )
    return out
