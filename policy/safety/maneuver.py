"""The ego's possible futures: where each meta-action leads it, along its real lane centre lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosim.actions import (
    LANE_CHANGE_TIME,
    MAX_DECEL,
    braked_from,
    next_target,
    speeds_ahead,
)
from cosim.road import LanePath, RoadMap
from cosim.types import Bools, Floats, History, MetaAction
from policy.motion import Rollout, fronts, pack, project, project_many, roll_out
from policy.safety.config import SafetyConfig

ACTIONS = tuple(MetaAction)
KEEPING = [ACTIONS.index(a) for a in (MetaAction.IDLE, MetaAction.ACCELERATE)]  # that brake later, if ever
SIDE = {MetaAction.LANE_LEFT: 0, MetaAction.LANE_RIGHT: 2}  # index into RouteAhead.paths
STOPPING = 40  # frames: 8 s, in which every AV stands
LANE_END = "(lane end)"
ROAD_EDGE = "(no lane)"
REFUSED = "(lane change was refused)"
UNDER_WAY = "(lane change under way)"
TOO_SLOW = "(too slow to change lanes)"
STRADDLING = "(stands across two lanes)"


class Way(NamedTuple):
    """Where one action leads."""

    path: LanePath
    changes: bool  # to another lane
    forbidden: str | None  # why it cannot be done


def ways_of(history: History, road: RoadMap, lane: int) -> list[Way]:
    """[A] the path of every action. While a lane change is under way all of them end in its target lane."""
    left, keep, right = history.route.paths
    assert keep is not None
    under_way = history.lane_changing
    if under_way:
        # the lane index flips half way: before that the target lane is the neighbour
        x, y, heading = history.pose
        half = 0.5 * float(history.kinematics[-1, 0, 4])
        x, y = x + half * np.cos(heading), y + half * np.sin(heading)  # front
        _, offset = project(keep.points, keep.arc, 0, len(keep.arc), x, y, history.route.arc)
        side = left if under_way > 0 else right
        if offset * under_way > 0.05 and side is not None:
            keep = side
    ways = []
    for action in ACTIONS:
        index = SIDE.get(action)
        if index is None:
            ways.append(Way(keep, False, None))
            continue
        target = history.route.paths[index]
        if target is None or under_way or road.lanes[lane].internal:
            ways.append(Way(keep, False, ROAD_EDGE if target is None else UNDER_WAY))
            continue
        worse = target.dead_end and (
            not keep.dead_end or target.length - history.route.arc < keep.length - history.route.arc - 1.0
        )
        ways.append(Way(target, True, LANE_END if worse else None))
    return ways


class Futures(NamedTuple):
    """The ego's possible futures."""

    under: Rollout  # [A,T+1] what each action is judged by
    intention: Rollout  # [A,T+1] what the allies are told
    stopping: Floats  # [A] m until standstill, when Decelerate follows from the next decision on


def roll_ego(history: History, paths: list[LanePath], now: Floats, c: SafetyConfig) -> Futures:
    """The ego (state `now` [8]) under every action, along the path of each.

    An action is held, as P's algorithm 2 says. Decelerating again and again means braking to a standstill, so
    Decelerate is judged by that: it is safe as long as braking helps. The allies are told of one step of it.
    """
    speed, limit = float(now[2]), history.route.speed_limit
    once, held, braked = speeds_ahead(
        history.target_speed, speed, limit, c.frames, STOPPING, c.dt, c.reaction
    )
    slower = ACTIONS.index(MetaAction.DECELERATE)
    speeds = np.concatenate([held, once[slower][None]])  # the last one: Decelerate once
    out = _roll(history, [*paths, paths[slower]], now, speeds, c)
    told = [*range(slower), len(ACTIONS), *range(slower + 1, len(ACTIONS))]
    return Futures(
        Rollout(*(array[: len(ACTIONS)] for array in out)),
        Rollout(*(array[told] for array in out)),
        np.asarray(c.dt * np.trapezoid(braked, axis=1)),
    )


def roll_braked(
    history: History, path: LanePath, now: Floats, under: Rollout, actions: list[int], c: SafetyConfig
) -> Rollout:
    """[k,T+1] the ego on `path` under `actions` for `brake_after` s, as in `under` [A,T+1], then braking."""
    held = min(round(c.brake_after / c.dt), c.frames)
    speeds = under.speed[actions].copy()
    limit = history.route.speed_limit
    for row, a in zip(speeds, actions, strict=True):
        target = next_target(history.target_speed, float(now[2]), a, limit)
        row[:] = braked_from(row, target, held, c.frames, limit, c.dt, c.reaction)
    return _roll(history, [path] * len(actions), now, speeds, c)


def _roll(history: History, paths: list[LanePath], now: Floats, speeds: Floats, c: SafetyConfig) -> Rollout:
    """[k,T+1] the ego on each of the k paths with the speeds of its row."""
    count = len(paths)
    packed = pack(paths)
    x, y = fronts(np.repeat(now[None], count, 0))
    arc, offset = project_many(*packed, x, y, np.full(count, history.route.arc))
    wide = np.abs(offset) > 0.3  # a lane change, new or under way
    return roll_out(
        packed,
        arc,
        offset,
        np.zeros(count),
        np.full(count, now[3]),
        np.where(wide, 2 * c.lane_half / LANE_CHANGE_TIME, 0.3),
        np.full(count, now[4]),
        speeds,
        np.full(count, np.inf),
        MAX_DECEL,
        c.dt,
    )


def straddles(ego: Rollout, c: SafetyConfig) -> Bools:
    """[A] whether the ego would come to a stop across two lanes."""
    standing = (ego.speed < 1.0) & (np.abs(ego.rear) > c.straddle)
    return np.asarray(standing.any(1))
