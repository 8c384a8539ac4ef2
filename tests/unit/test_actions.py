"""Meta-actions on the target-speed grid."""

import numpy as np
import pytest

from cosim.control import next_target, tracked_speed
from cosim.types import MetaAction

UP, DOWN, IDLE = MetaAction.ACCELERATE, MetaAction.DECELERATE, MetaAction.IDLE


def test_the_grid_rises_in_steps_of_five_to_the_limit_plus_two() -> None:
    levels = [0.0]
    while levels[-1] < 27.0:
        levels.append(next_target(levels[-1], levels[-1], UP, 25.0))
    assert levels == [0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 27.0]
    assert next_target(27.0, 27.0, UP, 25.0) == 27.0


def test_a_limit_off_the_grid_has_its_own_top_and_no_level_between() -> None:
    assert next_target(10.0, 10.0, UP, 13.9) == pytest.approx(15.9)
    assert next_target(15.9, 15.9, DOWN, 13.9) == 10.0


def test_braking_from_the_top_goes_back_to_the_grid_and_ends_at_standstill() -> None:
    assert next_target(27.0, 27.0, DOWN, 25.0) == 25.0
    assert next_target(25.0, 25.0, DOWN, 25.0) == 20.0
    assert next_target(0.0, 0.0, DOWN, 25.0) == 0.0


@pytest.mark.parametrize("speed", np.arange(0.5, 27.0, 0.37))
@pytest.mark.parametrize("target", [0.0, 12.0, 25.0, 27.0])
def test_decelerate_brakes_and_accelerate_accelerates_whatever_was_commanded_before(
    speed: float, target: float
) -> None:
    """By the least step at least and a level more at most, from the speed, not from a target far from it."""
    assert next_target(target, speed, DOWN, 25.0) <= max(min(target, speed) - 1.0, 0.0)
    assert next_target(target, speed, DOWN, 25.0) > max(min(target, speed) - 6.01, -0.01)
    assert next_target(target, speed, UP, 25.0) >= min(max(target, speed) + 1.0, 27.0)
    assert next_target(target, speed, UP, 25.0) < max(target, speed) + 6.01


def test_braking_goes_on_level_by_level_while_the_speed_lags_behind() -> None:
    assert next_target(20.0, 23.1, DOWN, 25.0) == 15.0
    assert next_target(15.0, 20.0, DOWN, 25.0) == 10.0


def test_idle_and_lane_changes_keep_the_target_and_a_first_one_the_present_speed() -> None:
    assert next_target(20.0, 16.3, IDLE, 25.0) == 20.0
    assert next_target(20.0, 16.3, MetaAction.LANE_RIGHT, 25.0) == 20.0
    assert next_target(17.0, 17.0, IDLE, 25.0) == 17.0, "rounded to 15 it would open a gap by itself"
    assert next_target(23.1, 23.1, MetaAction.LANE_LEFT, 25.0) == 23.1


def test_a_lower_limit_ahead_lowers_the_top() -> None:
    assert next_target(25.0, 25.0, IDLE, 13.9) == pytest.approx(15.9)


def test_tracking_brakes_with_eight_and_accelerates_with_three_at_most() -> None:
    assert tracked_speed(25.0, 0.0, 0.1) == pytest.approx(24.2)
    assert tracked_speed(10.0, 25.0, 0.1) == pytest.approx(10.3)
    assert tracked_speed(20.3, 20.0, 0.1) == pytest.approx(20.25)


def test_a_step_of_five_down_takes_about_two_seconds() -> None:
    speed, steps = 25.0, 0
    while speed > 20.2:
        speed, steps = tracked_speed(speed, 20.0, 0.1), steps + 1
    assert 15 <= steps <= 25


def test_a_speed_just_above_a_level_is_braked_gently() -> None:
    """The rounding that was here before braked from 22.4 m/s straight to 15."""
    assert next_target(25.0, 22.4, DOWN, 25.0) == 20.0
    assert next_target(20.0, 21.5, DOWN, 25.0) == 15.0, "below the target, not only below the speed"
