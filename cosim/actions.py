"""Meta-actions become commands: a target speed on a grid, and a lane (contract.md, Vehicles)."""

from __future__ import annotations

import math
from collections.abc import Mapping

from cosim.types import Command, Decision, History, MetaAction

SPEED_STEP = 5.0  # m/s between grid levels: "Decelerate" must be able to brake (compute.md)
SPEED_MARGIN = 2.0  # m/s above the speed limit: the highest level
TIME_CONSTANT = 0.6  # s, with which the target speed is tracked
MAX_DECEL = 8.0  # m/s2
MAX_ACCEL = 3.0  # m/s2

LANE_OFFSET = {MetaAction.LANE_LEFT: 1, MetaAction.LANE_RIGHT: -1}


def next_target(target: float, action: int, speed_limit: float) -> float:
    """The target speed after `action`, all in m/s.

    The grid is 0, 5, 10, ... up to the limit, and the limit + 2 on top. A target off the grid (an AV
    that was driven by SUMO so far) is first rounded to the grid.
    """
    top = speed_limit + SPEED_MARGIN
    if action == MetaAction.ACCELERATE:
        return min(math.floor(target / SPEED_STEP + 1e-6) * SPEED_STEP + SPEED_STEP, top)
    if action == MetaAction.DECELERATE:
        return min(max(math.ceil(target / SPEED_STEP - 1e-6) * SPEED_STEP - SPEED_STEP, 0.0), top)
    if target >= top:
        return top
    return min(round(target / SPEED_STEP) * SPEED_STEP, top)


def tracked_speed(speed: float, target: float, step: float) -> float:
    """Speed in m/s one simulation step (s) later, tracking `target` with the contract's limits."""
    accel = (target - speed) / TIME_CONSTANT
    return max(speed + min(max(accel, -MAX_DECEL), MAX_ACCEL) * step, 0.0)


def to_commands(
    decisions: Mapping[str, Decision], histories: Mapping[str, History], hold: float
) -> list[Command]:
    """One command per decided AV, held for `hold` s."""
    return [
        Command(
            vehicle,
            next_target(
                histories[vehicle].target_speed, decision.action, histories[vehicle].route.speed_limit
            ),
            LANE_OFFSET.get(decision.action, 0),
            hold,
        )
        for vehicle, decision in decisions.items()
    ]
