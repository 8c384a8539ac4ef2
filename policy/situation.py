"""What an AV knows in few numbers: its command, its lanes, who drives on them, and who has to yield.

The maps and kinematic rows hold nearly all of it too, but from the few drives that two cores have time for
a network does not find it there (docs/training.md, What it took to learn from few drives).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.actions import SPEED_STEP
from cosim.road import LanePath, RoadMap
from cosim.types import Floats32, History
from policy.meeting import LANE, Meeting, along, meet, missions

LOOK_AHEAD = np.array([20.0, 50.0, 100.0])  # m, where the candidate centre lines are sampled
FAR = 200.0  # m: lane ends and conflict zones further away are all alike
NEAR = 100.0  # m: neighbours further away are
FAST = 30.0  # m/s
PER_LANE = 3 + 2 * len(LOOK_AHEAD) + 4
SITUATION_INPUTS = 7 + 3 * PER_LANE + 6


def situation(histories: Sequence[History], road: RoadMap, shared: bool) -> Floats32:
    """[B,SITUATION_INPUTS], scaled to about [-1, 1], of AVs that decide together.

    Command (7): target speed, speed limit, distance to the conflict zone, lane change under way, own
    speed, how many grid levels the target may still rise, how far the speed is from it. Then for the left,
    present and right lane: does it exist, does it dead-end, how far off, where its centre line lies
    LOOK_AHEAD m ahead (offset and direction in the ego frame), and gap and relative speed of the next
    vehicle ahead and behind. Last (6) the mission vehicle whose way meets the AV's: is there one, how far
    behind it the AV will arrive, how far the AV arriving before it, do they cross, does it come from the
    right, its speed. `shared`: V2V, mission vehicles and places in that order are known to all.
    """
    met = _met(histories, road, shared)
    return np.array([_own(h) + _lanes(h) + m for h, m in zip(histories, met, strict=True)], np.float32)


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


def _lanes(history: History) -> list[float]:
    route, pose = history.route, history.pose
    c, s = np.cos(pose[2]), np.sin(pose[2])
    out: list[float] = []
    for side, path in enumerate(route.paths):
        if path is None:
            out += [0.0] * PER_LANE
            continue
        x, y, heading = path.pose(route.arc + LOOK_AHEAD)
        left = c * (y - pose[1]) - s * (x - pose[0])
        turn = (heading - pose[2] + np.pi) % (2 * np.pi) - np.pi
        out += [1.0, float(path.dead_end), min(route.to_end(side), FAR) / FAR]
        out += [float(v) for v in left / 50.0] + [float(v) for v in turn / np.pi]
        out += _neighbours(history, path, (1 - side) * LANE)
    return out


def _neighbours(history: History, path: LanePath, side: float) -> list[float]:
    """Gap (centres) and relative speed of the next vehicle ahead and behind; 1 and 0 where there is none."""
    others = along(history, path, side)
    out = []
    for direction in (1.0, -1.0):
        gap, speed = min(
            ((direction * x, v) for x, v in others if direction * x > 0.0),
            default=(NEAR, history.ego_speed),
        )
        out += [min(gap, NEAR) / NEAR, (speed - history.ego_speed) / FAST]
    return out


def _met(histories: Sequence[History], road: RoadMap, shared: bool) -> list[list[float]]:
    """Of every AV [6]: the mission vehicle it comes closest to; who else arrives before it."""
    if not shared:
        return [_order([h], road)[0] for h in histories]
    return _order(histories, road)


def _order(histories: Sequence[History], road: RoadMap) -> list[list[float]]:
    nobody = [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    meetings: list[Mapping[str, Meeting]] = []
    seen = missions(histories)
    for history in histories:
        own = {name: meet(road, history, at) for name, at in seen.items()}
        meetings.append({name: m for name, m in own.items() if m is not None})
    out = []
    for mine in meetings:
        if not mine:
            out.append(nobody)
            continue
        name = min(mine, key=lambda n: abs(mine[n].behind))
        m = mine[name]
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
