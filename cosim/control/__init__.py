"""Converts meta-actions into commands: a target speed on a grid, and a lane (presets.md, Commands)."""

import math
from collections.abc import Mapping

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.road.rules import RED, YELLOW, RulesAhead
from cosim.types import LANE_OFFSET, Command, Decision, Floats, History, MetaAction

SPEED_STEP = 5.0  # m/s between grid levels: one step of Decelerate must really brake
SPEED_MARGIN = 2.0  # m/s above the speed limit, of the highest level
MIN_SPEED_STEP = 1.0  # m/s, the smallest change of the target
TIME_CONSTANT = 0.6  # s, of tracking the target speed
MAX_DECEL = 8.0  # m/s2
MAX_ACCEL = 3.0  # m/s2
COMFORT_ACCEL = 2.8  # m/s2, the bound of acceleration and braking on an agent's wish in preset `lawful`
MAX_JERK = 5.0  # m/s3, of that acceleration (ISO 15622: adaptive cruise control at low speeds)
APPROACH_DECEL = 2.0  # m/s2, before stop lines and lower speed limits
STOP_LINE_MARGIN = 1.0  # m before a stop line
CREEP_SPEED = 2.0  # m/s
COMFORT_TIME_CONSTANT = 1.0  # s, of tracking the target speed in preset `lawful`
LANE_CHANGE_TIME = 2.0  # s, the same as SUMO's --lanechange.duration
_ACTIONS, _ACCELERATE, _DECELERATE = len(MetaAction), int(MetaAction.ACCELERATE), int(MetaAction.DECELERATE)
_NO_PERIOD = 1e9  # s between decisions, longer than any rollout
ROLLOUT_STEP = 0.1  # s, of tracking in a rollout (SUMO's step)


def next_target(target: float, speed: float, action: int, speed_limit: float) -> float:
    """The target speed in m/s after a meta-action (presets.md, Commands).

    Args:
        target, speed: m/s, the AV's present target speed and speed.
        action: a `MetaAction`.
        speed_limit: m/s, of the AV's lane.

    The levels are 0, 5, 10, ... up to the limit, and the limit + 2 on top. Decelerate chooses the highest
    level at least `MIN_SPEED_STEP` below the lower of target and speed. Accelerate chooses the lowest level
    as much above the higher of both. So either takes effect at once, however far the target was from the
    speed. Other actions keep the target, on the grid or not. No target exceeds the top level.
    """
    return float(_next_target(target, speed, int(action), speed_limit))


@compiled
def _next_target(target: float, speed: float, action: int, speed_limit: float) -> float:
    top = speed_limit + SPEED_MARGIN
    whole = math.floor(speed_limit / SPEED_STEP + 1e-6)  # the highest multiple of the step in the limit
    if action == _ACCELERATE:
        level = math.ceil((max(target, speed) + MIN_SPEED_STEP) / SPEED_STEP - 1e-6)
        return level * SPEED_STEP if level <= whole else top
    if action == _DECELERATE:
        below = min(target, speed) - MIN_SPEED_STEP
        level = min(math.floor(below / SPEED_STEP + 1e-6), whole)
        return top if below >= top else max(level, 0) * SPEED_STEP
    return min(target, top)


@compiled
def tracked_speed(speed: float, target: float, step: float) -> float:
    """The speed in m/s after one simulation step of tracking a target speed, within an AV's limits.

    Args:
        speed, target: m/s. The difference decays with `TIME_CONSTANT`, at -`MAX_DECEL` to `MAX_ACCEL`.
        step: s.
    """
    accel = (target - speed) / TIME_CONSTANT
    return max(speed + min(max(accel, -MAX_DECEL), MAX_ACCEL) * step, 0.0)


def courtesy(svo: float) -> float:
    """The share of lawful AVs that slow down for vehicles that must change lanes, as SUMO's drivers do.

    `svo`: phi in rad. The value is the weight of others, sin(phi), over the AV's own, cos(phi) (P, eq. (6)),
    at most 1.
    """
    own, others = math.cos(svo), math.sin(svo)
    return 1.0 if others >= own and others > 0.0 else max(others / own, 0.0) if own > 0.0 else 0.0


def wished_accel(speed: float, target: float, accel: float, step: float) -> tuple[float, float]:
    """The acceleration that a target speed asks for in preset `lawful`, and the same with bounded jerk, m/s2.

    Args:
        speed, target: m/s.
        accel: m/s2, of the previous step, from which `MAX_JERK` bounds the change.
        step: s.
    """
    asked = min(max((target - speed) / COMFORT_TIME_CONSTANT, -COMFORT_ACCEL), COMFORT_ACCEL)
    before = min(max(accel, -COMFORT_ACCEL), COMFORT_ACCEL)
    return asked, min(max(asked, before - MAX_JERK * step), before + MAX_JERK * step)


@compiled
def braking_speeds(speed: float, target: float, frames: int, dt: float, period: float) -> Floats:
    """The speeds of repeated Decelerate actions.

    Args:
        speed, target: m/s at the start; the first Decelerate has already lowered the target.
        frames, dt: the number of frames, and s between them.
        period: s between decisions; each decision lowers the target by one level.

    Returns:
        [frames+1] m/s, from the present on.
    """
    out = np.empty(frames + 1)
    v = speed
    out[0] = v
    steps = max(round(dt / ROLLOUT_STEP), 1)
    left = per_level = max(round(period / ROLLOUT_STEP), 1)
    for t in range(1, frames + 1):
        for _ in range(steps):
            if left == 0:
                target = max(target - SPEED_STEP, 0.0)
                left = per_level
            left -= 1
            v = tracked_speed(v, target, dt / steps)
        out[t] = v
    return out


@compiled
def tracked_speeds(speed: float, targets: Floats, frames: int, dt: float) -> Floats:
    """The speeds of tracking k constant target speeds.

    Args:
        speed: m/s at the start.
        targets: [k] m/s.
        frames, dt: the number of frames, and s between them.

    Returns:
        [k,frames+1] m/s, from the present on.
    """
    out = np.empty((targets.shape[0], frames + 1))
    for k in range(targets.shape[0]):
        out[k] = braking_speeds(speed, targets[k], frames, dt, _NO_PERIOD)
    return out


@compiled
def speeds_ahead(
    target: float, speed: float, limit: float, frames: int, stopping: int, dt: float, period: float
) -> tuple[Floats, Floats]:
    """The speeds that every action leads to, and the stopping distance after it.

    Args:
        target, speed, limit: m/s, the AV's present target speed, its speed and its lane's speed limit.
        frames: the number of frames of speeds.
        stopping: the number of frames over which the stopping distance is summed.
        dt: s between frames.
        period: s between decisions.

    Returns:
        [A+1,frames+1] m/s with the action held. A held Decelerate is repeated at every decision; the last row
        is a single Decelerate. [A] m driven within `stopping` frames, if Decelerate follows the action from
        the next decision on.
    """
    targets = np.empty(_ACTIONS + 1)
    for a in range(_ACTIONS):
        targets[a] = _next_target(target, speed, a, limit)
    targets[_ACTIONS] = targets[_DECELERATE]
    held = tracked_speeds(speed, targets, frames, dt)
    held[_DECELERATE] = braking_speeds(speed, targets[_DECELERATE], frames, dt, period)
    way = np.zeros(_ACTIONS)
    for a in range(_ACTIONS):
        braked = braked_from(held[a], targets[a], round(period / dt), stopping, limit, dt, period)
        for t in range(stopping):
            way[a] += 0.5 * dt * (braked[t] + braked[t + 1])
    return held, way


@compiled
def braked_from(
    speeds: Floats, target: float, held: int, frames: int, limit: float, dt: float, period: float
) -> Floats:
    """The first `held` frames of given speeds, followed by Decelerate at every decision.

    Args:
        speeds: [>held] m/s, every `dt` s.
        target: m/s, tracked in the held frames.
        held, frames: the number of frames until the first Decelerate, and in all.
        limit: m/s, the lane's speed limit.
        dt, period: s between frames, and between decisions.

    Returns:
        [frames+1] m/s.
    """
    then = speeds[held]
    out = np.empty(frames + 1)
    out[:held] = speeds[:held]
    out[held:] = braking_speeds(
        then, _next_target(target, then, _DECELERATE, limit), frames - held, dt, period
    )
    return out


def lawful_speed(rules: RulesAhead) -> float:
    """The highest speed in m/s that obeys the law ahead with a braking of `APPROACH_DECEL`.

    The law: speed limits (of junction lanes too), red and yellow lights, stop signs, crossings with persons.
    The speed is at least `CREEP_SPEED`: the car itself drives the last metres and decides on passing a line.
    """
    allowed = np.sqrt(rules.limits[:, 1] ** 2 + 2.0 * APPROACH_DECEL * rules.limits[:, 0]).min()
    at = [rules.stop_distance, rules.person_distance]
    if rules.signal and rules.signal in RED + YELLOW:
        at.append(rules.signal_distance)
    stop = math.sqrt(2.0 * APPROACH_DECEL * max(min(at) - STOP_LINE_MARGIN, 0.0))
    return float(min(allowed, max(stop, CREEP_SPEED)))


def to_commands(
    decisions: Mapping[str, Decision], histories: Mapping[str, History], hold: float, lawful: bool = False
) -> list[Command]:
    """One command per decided AV.

    Args:
        decisions: AV id -> its policy's decision.
        histories: AV id -> its history: target speed, speed, speed limit (m/s) and the law ahead.
        hold: s until the next decision.
        lawful: whether commands obey the visible law ahead (preset `lawful`).
    """
    commands = []
    for vehicle, decision in decisions.items():
        history = histories[vehicle]
        limit, highest = math.inf, history.route.speed_limit
        if lawful:  # a slow junction lane does not lower the wish for the road beyond it
            limit, ahead = lawful_speed(history.rules), float(history.rules.limits[:, 1].max())
            highest = ahead if math.isfinite(ahead) else highest
        speed, accel = history.ego_speed, decision.accel
        if accel is None:
            target = next_target(history.target_speed, speed, decision.action, highest)
        else:
            top = max(highest + SPEED_MARGIN, speed)
            accel = min(max(accel, -MAX_DECEL), MAX_ACCEL, (top - speed) / hold)
            target = max(speed + accel * hold, 0.0)
        commands.append(Command(vehicle, target, LANE_OFFSET.get(decision.action, 0), hold, limit, accel))
    return commands
