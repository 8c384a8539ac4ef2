"""Meta-actions become commands: a target speed on a grid, and a lane (presets.md, Commands)."""

import math
from collections.abc import Mapping

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.road.rules import RED, YELLOW, RulesAhead
from cosim.types import LANE_OFFSET, Command, Decision, Floats, History, MetaAction

SPEED_STEP = 5.0  # m/s between grid levels: one step of Decelerate must really brake
SPEED_MARGIN = 2.0  # m/s above the speed limit: the highest level
LEAST_STEP = 1.0  # m/s: what a step changes at least
TIME_CONSTANT = 0.6  # s, with which the target speed is tracked
MAX_DECEL = 8.0  # m/s2
MAX_ACCEL = 3.0  # m/s2
COMFORT = 2.8  # m/s2: the most that preset `lawful` accelerates or brakes on an agent's wish
JERK = 5.0  # m/s3, how fast that changes (ISO 15622: adaptive cruise control at low speeds)
APPROACH = 2.0  # m/s2, with which stop lines and lower limits are approached
STOPS_BEFORE = 1.0  # m from a stop line
CREEP = 2.0  # m/s
COMFORT_TIME = 1.0  # s, with which a target speed is tracked comfortably
LANE_CHANGE_TIME = 2.0  # s, the same as SUMO's --lanechange.duration
_ACTIONS, _ACCELERATE, _DECELERATE = len(MetaAction), int(MetaAction.ACCELERATE), int(MetaAction.DECELERATE)
_NEVER = 1e9  # s: longer than any rollout
STEP = 0.1  # s, with which a rollout tracks the target speed (SUMO's step)


def next_target(target: float, speed: float, action: int, speed_limit: float) -> float:
    """The target speed in m/s after a meta-action (presets.md, Commands).

    Args:
        target, speed: m/s, the AV's present target and its own speed.
        action: a `MetaAction`.
        speed_limit: m/s, of its lane.

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
    """Speed in m/s one simulation step later, tracking a target speed within an AV's limits.

    Args:
        speed, target: m/s. The difference decays with `TIME_CONSTANT`, at -`MAX_DECEL` to `MAX_ACCEL`.
        step: s.
    """
    accel = (target - speed) / TIME_CONSTANT
    return max(speed + min(max(accel, -MAX_DECEL), MAX_ACCEL) * step, 0.0)


def courtesy(svo: float) -> float:
    """How far a lawful car slows down for vehicles that must change lanes: 0 not at all, 1 as SUMO's drivers.

    `svo`: phi in rad. The weight of others in P's eq. (6), sin(phi), as a share of the AV's own, cos(phi).
    """
    own, others = math.cos(svo), math.sin(svo)
    return 1.0 if others >= own and others > 0.0 else max(others / own, 0.0) if own > 0.0 else 0.0


def wished_accel(speed: float, target: float, accel: float, step: float) -> tuple[float, float]:
    """The acceleration that a target speed asks for in preset `lawful`, and its comfortable course, m/s2.

    Args:
        speed, target: m/s.
        accel: m/s2, of the step before, which `JERK` bounds the change from.
        step: s.
    """
    asked = min(max((target - speed) / COMFORT_TIME, -COMFORT), COMFORT)
    before = min(max(accel, -COMFORT), COMFORT)
    return asked, min(max(asked, before - JERK * step), before + JERK * step)


@compiled
def braking_speeds(speed: float, target: float, frames: int, dt: float, period: float) -> Floats:
    """Speeds while Decelerate is repeated.

    Args:
        speed, target: m/s at the start; the target is lowered once already.
        frames, dt: how many frames ahead, and s between them.
        period: s between decisions: each lowers the target by one level.

    Returns:
        [frames+1] m/s, the first entry the present.
    """
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
    """Speeds while k constant target speeds are tracked.

    Args:
        speed: m/s at the start.
        targets: [k] m/s.
        frames, dt: how many frames ahead, and s between them.

    Returns:
        [k,frames+1] m/s, the first column the present.
    """
    out = np.empty((targets.shape[0], frames + 1))
    for k in range(targets.shape[0]):
        out[k] = braking_speeds(speed, targets[k], frames, dt, _NEVER)
    return out


@compiled
def speeds_ahead(
    target: float, speed: float, limit: float, frames: int, stopping: int, dt: float, period: float
) -> tuple[Floats, Floats]:
    """The speeds that every action leads to, and how far it is to standstill after it.

    Args:
        target, speed, limit: m/s, the AV's present target, its speed and its lane's speed limit.
        frames: how many frames of speeds are wanted.
        stopping: how many frames the way to standstill is added up over.
        dt: s between frames.
        period: s between decisions.

    Returns:
        [A+1,frames+1] m/s of the actions held, which for Decelerate means again at every decision; the last
        row is Decelerate once. [A] m driven within `stopping` frames when Decelerate follows every action
        from the next decision on.
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
    """The first `held` frames of a course of speeds, then Decelerate at every decision.

    Args:
        speeds: [>held] m/s, every `dt` s.
        target: m/s, tracked until then.
        held, frames: frames until the first Decelerate, and in all.
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
    """The highest speed in m/s from which `APPROACH` m/s2 obey all that a car sees of the law ahead.

    Limits (junction lanes too), red and yellow lights, stop signs and crossings with persons; never below
    `CREEP`: how the last metres are driven, and whether a line may be passed, is the car's to say.
    """
    allowed = np.sqrt(rules.limits[:, 1] ** 2 + 2.0 * APPROACH * rules.limits[:, 0]).min()
    at = [rules.stop_distance, rules.person_distance]
    if rules.signal and rules.signal in RED + YELLOW:
        at.append(rules.signal_distance)
    stop = math.sqrt(2.0 * APPROACH * max(min(at) - STOPS_BEFORE, 0.0))
    return float(min(allowed, max(stop, CREEP)))


def to_commands(
    decisions: Mapping[str, Decision], histories: Mapping[str, History], hold: float, lawful: bool = False
) -> list[Command]:
    """One command per decided AV.

    Args:
        decisions: AV id -> what its policy chose.
        histories: AV id -> its history, for its target speed, speed, speed limit (m/s) and the law ahead.
        hold: s until the next decision.
        lawful: whether commands keep what is seen of the law ahead (preset `lawful`).
    """
    commands = []
    for vehicle, decision in decisions.items():
        history = histories[vehicle]
        limit, highest = math.inf, history.route.speed_limit
        if lawful:  # a slow lane inside a junction lowers no wish for the road behind it
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
