"""Meta-actions become commands: a target speed on a grid, and a lane (definitions.md, Vehicles)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.types import LANE_OFFSET, Command, Decision, Floats, History, MetaAction

SPEED_STEP = 5.0  # m/s between grid levels: one step of Decelerate must really brake
SPEED_MARGIN = 2.0  # m/s above the speed limit: the highest level
LEAST_STEP = 1.0  # m/s: what a step changes at least
TIME_CONSTANT = 0.6  # s, with which the target speed is tracked
MAX_DECEL = 8.0  # m/s2
MAX_ACCEL = 3.0  # m/s2
LANE_CHANGE_TIME = 2.0  # s, the same as SUMO's --lanechange.duration
_ACTIONS, _ACCELERATE, _DECELERATE = len(MetaAction), int(MetaAction.ACCELERATE), int(MetaAction.DECELERATE)
_NEVER = 1e9  # s: longer than any rollout
STEP = 0.1  # s, with which a rollout tracks the target speed (SUMO's step, definitions.md)


def next_target(target: float, speed: float, action: int, speed_limit: float) -> float:
    """The target speed after `action`, all in m/s; `speed` is the AV's present one.

    The levels are 0, 5, 10, ... up to the limit, and the limit + 2 on top. Decelerate goes to the highest
    level at least `LEAST_STEP` below the lower of target and speed, Accelerate to the lowest one as much
    above the higher: so Decelerate brakes at once, however far the target had run ahead of the speed, and
    Accelerate ends a braking at once. All others keep the target, on the grid or not, and no target exceeds
    the top.
    """
    return float(_next_target(target, speed, int(action), speed_limit))


@compiled
def _next_target(target: float, speed: float, action: int, speed_limit: float) -> float:
    top = speed_limit + SPEED_MARGIN
    whole = math.floor(speed_limit / SPEED_STEP + 1e-6)  # the highest multiple of the step in the limit
    if action == _ACCELERATE:
        level = math.ceil((max(target, speed) + LEAST_STEP) / SPEED_STEP - 1e-6)
        return level * SPEED_STEP if level <= whole else top
    if action == _DECELERATE:
        below = min(target, speed) - LEAST_STEP
        level = min(math.floor(below / SPEED_STEP + 1e-6), whole)
        return top if below >= top else max(level, 0) * SPEED_STEP
    return min(target, top)


@compiled
def tracked_speed(speed: float, target: float, step: float) -> float:
    """Speed in m/s one simulation step (s) later, tracking `target` within an AV's limits."""
    accel = (target - speed) / TIME_CONSTANT
    return max(speed + min(max(accel, -MAX_DECEL), MAX_ACCEL) * step, 0.0)


@compiled
def braking_speeds(speed: float, target: float, frames: int, dt: float, period: float) -> Floats:
    """Speeds [frames+1] m/s when the target (m/s, already lowered once) falls one level every `period` s."""
    out = np.empty(frames + 1)
    v = speed
    out[0] = v
    steps = max(round(dt / STEP), 1)
    left = per_level = max(round(period / STEP), 1)
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
    """Speeds while tracking target speeds [k] m/s from `speed`: [k,frames+1] m/s, every `dt` s."""
    out = np.empty((targets.shape[0], frames + 1))
    for k in range(targets.shape[0]):
        out[k] = braking_speeds(speed, targets[k], frames, dt, _NEVER)
    return out


@compiled
def speeds_ahead(
    target: float, speed: float, limit: float, frames: int, stopping: int, dt: float, period: float
) -> tuple[Floats, Floats]:
    """What every action means, every `dt` s, and how far it is to standstill.

    Speeds [A+1,frames+1] m/s of the actions held, which for Decelerate means again at every decision,
    `period` s apart; the last row is Decelerate once. [A] m driven within `stopping` frames when Decelerate
    follows from the next decision on.
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
    """[frames+1] m/s: the first `held` frames of `speeds`, at `target`, then Decelerate every `period` s."""
    then = speeds[held]
    out = np.empty(frames + 1)
    out[:held] = speeds[:held]
    lowered = _next_target(target, then, _DECELERATE, limit)
    out[held:] = braking_speeds(then, lowered, frames - held, dt, period)
    return out


def to_commands(
    decisions: Mapping[str, Decision], histories: Mapping[str, History], hold: float
) -> list[Command]:
    """One command per decided AV, held for `hold` s."""
    commands = []
    for vehicle, decision in decisions.items():
        history = histories[vehicle]
        target = next_target(
            history.target_speed, history.ego_speed, decision.action, history.route.speed_limit
        )
        commands.append(Command(vehicle, target, LANE_OFFSET.get(decision.action, 0), hold))
    return commands
