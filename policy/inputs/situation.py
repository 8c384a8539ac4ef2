"""What an AV perceives in few numbers: its command, its lanes, who drives on them, and who has to yield.

The maps and kinematic rows hold nearly all of it too, but from the few drives that two cores have time for
a network does not find it there.
"""

from collections.abc import Sequence

import numpy as np

from cosim.control import SPEED_STEP
from cosim.geometry.compiled import compiled
from cosim.road import RoadMap
from cosim.types import Floats, Floats32, History
from policy.inputs.meeting import LANE, along, meet, missions

LOOK_AHEAD = np.array([20.0, 50.0, 100.0])  # m, where the candidate centre lines are sampled
FAR = 200.0  # m: lane ends and conflict zones further away are all alike
NEAR = 100.0  # m: neighbours further away are
FAST = 30.0  # m/s
OWN = 7  # numbers of the command, before the lanes
PER_LANE = 3 + 2 * len(LOOK_AHEAD) + 4
MISSION = OWN + 3 * PER_LANE  # the six numbers of the mission vehicle begin here
SITUATION_INPUTS = MISSION + 6


def situation(histories: Sequence[History], road: RoadMap, shared: bool) -> Floats32:
    """[B,SITUATION_INPUTS], scaled to about [-1, 1], of AVs that decide together.

    Command (7): target speed, speed limit, distance to the conflict zone, lane change under way, own
    speed, how many grid levels the target may still rise, how far the speed is from it. Then for the left,
    present and right lane: does it exist, does it dead-end, how far off, where its centre line lies
    LOOK_AHEAD m ahead (offset and direction in the ego frame), and gap and relative speed of the next
    vehicle ahead and behind. Then (6) the mission vehicle whose way meets the AV's: is there one, how far
    behind it the AV will arrive, how far the AV arriving before it, do they cross, does it come from the
    right, its speed. `shared`: V2V, mission vehicles and places in that order are known to all.
    """
    met = _met(histories, road, shared)
    each = [np.concatenate([_own(h), _lanes(h), m]) for h, m in zip(histories, met, strict=True)]
    return np.array(each, np.float32)


def _own(history: History) -> list[float]:
    route = history.route
    return [
        history.target_speed / FAST,
        route.speed_limit / FAST,
        min(route.conflict_distance, FAR) / FAR,
        float(history.lane_changing),
        history.ego_speed / FAST,
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
            others = along(history, path, (1 - side) * LANE)
            end = min(route.to_end(side), FAR) / FAR
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
    """One lane that exists: its course at `places` m, and its next vehicles ahead and behind of `others`."""
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
    for direction in (1.0, -1.0):  # gap (centres) and relative speed; 1 and 0 where there is nobody
        gap, theirs = np.inf, speed
        for k in range(len(others)):
            if 0.0 < direction * others[k, 0] < gap:
                gap, theirs = direction * others[k, 0], others[k, 1]
        out[at], out[at + 1] = min(gap, NEAR) / NEAR, (theirs - speed) / FAST
        at += 2


def _met(histories: Sequence[History], road: RoadMap, shared: bool) -> list[list[float]]:
    """Of every AV [6]: the mission vehicle it comes closest to; who else arrives before it."""
    if not shared:
        return [_order([h], road)[0] for h in histories]
    return _order(histories, road)


def _order(histories: Sequence[History], road: RoadMap) -> list[list[float]]:
    absent = [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    seen = missions(histories).items()
    meetings = [{name: m for name, at in seen if (m := meet(road, h, at)) is not None} for h in histories]
    out = []
    for mine in meetings:
        if not mine:
            out.append(absent)
            continue
        name, m = min(mine.items(), key=lambda item: abs(item[1].behind))
        before = [o[name].behind for o in meetings if name in o and o[name].behind < m.behind]
        next_before = max(before, default=-FAR)
        out.append(
            [
                1.0,
                min(max(m.behind / FAR, -1.0), 1.0),
                max(next_before / FAR, -1.0),
                float(m.crossing),
                float(m.from_right),
                m.speed / FAST,
            ]
        )
    return out
