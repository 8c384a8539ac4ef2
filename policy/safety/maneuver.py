"""The ego's possible futures: its path under each meta-action, along real lane centre lines."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cosim.control import (
    LANE_CHANGE_TIME,
    MAX_DECEL,
    braked_from,
    next_target,
    speeds_ahead,
)
from cosim.geometry.compiled import compiled
from cosim.road import LanePath, RoadMap
from cosim.types import Bools, Floats, History, Ints, MetaAction
from policy.prediction.motion import Paths, Rollout, pack, project, roll_one
from policy.safety.config import SafetyConfig

ACTIONS = tuple(MetaAction)
HELD_ACTIONS = [ACTIONS.index(a) for a in (MetaAction.IDLE, MetaAction.ACCELERATE)]  # not braking at once
CHANGE_PATH = {MetaAction.LANE_LEFT: 0, MetaAction.LANE_RIGHT: 2}  # index into RouteAhead.paths
DECELERATE = ACTIONS.index(MetaAction.DECELERATE)
CHANGE_OFFSET = 0.3  # m, lateral offset from a centre line that counts as a lane change
CENTERING = 0.3  # m/s, lateral speed at smaller offsets
STOPPING_FRAMES = 40  # frames (8 s), enough for every AV to stop
LANE_END = "(lane end)"
ROAD_EDGE = "(no lane)"
REFUSED = "(lane change was refused)"
UNDER_WAY = "(lane change under way)"
TOO_SLOW = "(too slow to change lanes)"
STRADDLING = "(stands across two lanes)"


class ActionPath(NamedTuple):
    """The path of one action."""

    path: LanePath
    changes: bool  # to another lane
    forbidden: str | None  # reason why the action is impossible


def paths_of_actions(history: History, road: RoadMap, lane: int) -> list[ActionPath]:
    """[A] the path of every action. During a lane change all paths end in its target lane."""
    left, keep, right = history.route.paths
    assert keep is not None
    under_way = history.lane_changing
    if under_way:
        # the lane index changes half way: until then the target lane is the adjacent one
        x, y, heading = history.pose
        half = 0.5 * float(history.kinematics[-1, 0, 4])
        x, y = x + half * np.cos(heading), y + half * np.sin(heading)  # front
        _, offset = project(keep.points, keep.arc, 0, len(keep.arc), x, y, history.route.arc)
        side = left if under_way > 0 else right
        if offset * under_way > 0.05 and side is not None:
            keep = side
    ways = []
    for action in ACTIONS:
        index = CHANGE_PATH.get(action)
        if index is None:
            ways.append(ActionPath(keep, False, None))
            continue
        target = history.route.paths[index]
        if target is None or under_way or road.lanes[lane].internal:
            ways.append(ActionPath(keep, False, ROAD_EDGE if target is None else UNDER_WAY))
            continue
        worse = target.dead_end and (
            not keep.dead_end or target.length - history.route.arc < keep.length - history.route.arc - 1.0
        )
        ways.append(ActionPath(target, True, LANE_END if worse else None))
    return ways


class ActionPaths(NamedTuple):
    """The paths of all actions as arrays for the kernels."""

    paths: Paths  # [A+1] of every action, then Decelerate's again
    same: Ints  # [A] first action with the same path
    dead_end: Bools  # [A]
    length: Floats  # [A] m


@lru_cache(maxsize=1024)
def packed(paths: tuple[LanePath, ...]) -> ActionPaths:
    """The packed [A] paths; cached, because consecutive decisions share them."""
    same = [next(k for k, other in enumerate(paths) if other is path) for path in paths]
    return ActionPaths(
        pack([*paths, paths[DECELERATE]]),
        np.array(same, np.int64),
        np.array([path.dead_end for path in paths]),
        np.array([path.length for path in paths]),
    )


class Futures(NamedTuple):
    """The ego's possible futures."""

    under: Rollout  # [A+1,T+1] the evaluated future of each action, then a single Decelerate
    stopping: Floats  # [A] m, stopping distance with Decelerate from the next decision on

    def shared(self, action: int) -> list[Floats]:
        """The shared intention [6][T+1]; for Decelerate, of a single step."""
        row = len(ACTIONS) if action == DECELERATE else action
        return [array[row] for array in self.under]


def roll_ego(history: History, paths: Paths, now: Floats, c: SafetyConfig) -> Futures:
    """The ego (state `now` [8]) under every action, along the path [A+1] of each.

    An action is held, as in P's algorithm 2. Repeated Decelerate is braking to a standstill, so Decelerate is
    evaluated that way: it is safe while braking helps.
    """
    speeds, stopping = speeds_ahead(
        history.target_speed,
        float(now[2]),
        history.route.speed_limit,
        c.frames,
        STOPPING_FRAMES,
        c.dt,
        c.reaction,
    )
    return Futures(_roll(history, paths, now, speeds, c), stopping)


def roll_braked(
    history: History, path: LanePath, now: Floats, under: Rollout, actions: list[int], c: SafetyConfig
) -> Rollout:
    """[k,T+1] the ego on `path` under `actions` for `brake_after` s, as in `under` [.,T+1], then braking."""
    held = min(round(c.brake_after / c.dt), c.frames)
    speeds = under.speed[actions]
    limit = history.route.speed_limit
    for row, a in zip(speeds, actions, strict=True):
        target = next_target(history.target_speed, float(now[2]), a, limit)
        row[:] = braked_from(row, target, held, c.frames, limit, c.dt, c.reaction)
    return _roll(history, _repeated(path, len(actions)), now, speeds, c)


@lru_cache(maxsize=1024)
def _repeated(path: LanePath, times: int) -> Paths:
    """The path, repeated `times` times."""
    return pack([path] * times)


def _roll(history: History, paths: Paths, now: Floats, speeds: Floats, c: SafetyConfig) -> Rollout:
    """[k,T+1] the ego on each of the k paths with the speeds of that row."""
    change = 2 * c.lane_half / LANE_CHANGE_TIME
    around = history.route.arc
    return Rollout(*roll_one(*paths, now, around, speeds, CHANGE_OFFSET, change, CENTERING, MAX_DECEL, c.dt))


def straddling(ego: Rollout, c: SafetyConfig) -> Ints:
    """Actions under which the ego would stop across two lanes."""
    return _straddling(ego.speed, ego.rear, c.straddle)


@compiled
def _straddling(speed: Floats, rear: Floats, beside: float) -> Ints:
    found = np.zeros(speed.shape[0], np.bool_)
    for a in range(speed.shape[0]):
        for t in range(speed.shape[1]):
            found[a] |= speed[a, t] < 1.0 and abs(rear[a, t]) > beside
    return np.flatnonzero(found)


def at_lane_end(ego: Rollout, course: ActionPaths, c: SafetyConfig) -> dict[int, float]:
    """Action -> s until it reaches the end of its lane, treated as an obstacle."""
    frames = _frames_to(ego.arc, course.length, course.dead_end).tolist()
    return {a: c.dt * t for a, t in enumerate(frames) if t >= 0}


@compiled
def _frames_to(arc: Floats, length: Floats, dead_end: Bools) -> Ints:
    """[A] first frame with the front at the end of a dead end, -1 for never; arc [A,T+1] m."""
    out = np.full(arc.shape[0], -1)
    for a in np.flatnonzero(dead_end):
        for t in range(arc.shape[1]):
            if arc[a, t] + 0.5 > length[a]:
                out[a] = t
                break
    return out
