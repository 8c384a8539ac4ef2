"""The demonstrator: what it shows a learner that does not see its own command."""

from __future__ import annotations

import math

import numpy as np
import pytest
from policy_scenes import LIMIT, Car, histories, straight_road

from cosim.types import COMPACT, MetaAction, PolicyContext, Timing
from policy.agents.idm import ACCEL, desired_gap
from policy.inputs.meeting import CAR
from policy.training.demonstrator import EAGER, TIME_GAP, Demonstrator


@pytest.mark.parametrize(
    ("wished", "good"), [(1.5, MetaAction.ACCELERATE), (0.0, MetaAction.IDLE), (-2.0, MetaAction.DECELERATE)]
)
def test_a_learner_that_sees_maps_alone_is_shown_what_can_be_seen(wished: float, good: MetaAction) -> None:
    """Whatever is commanded: an AV that brakes for another vehicle already is shown braking."""
    road = straight_road(lanes=1)
    speed = 20.0
    # IDM's acceleration by the gap alone, behind a vehicle as fast: free road less (wished gap / gap)^2
    free = ACCEL * (1.0 - (speed / (LIMIT + EAGER)) ** 4)
    gap = desired_gap(speed, speed, TIME_GAP) / math.sqrt((free - wished) / ACCEL)
    shown = []
    for target in (5.0, 20.0, 25.0):
        cars = [Car("a", 100.0, 0, speed, is_av=True, target=target), Car("b", 100.0 + gap + CAR, 0, speed)]
        demonstrator = Demonstrator(knows_command=False)
        demonstrator.reset(PolicyContext(road, Timing(), COMPACT, 0.0, np.random.default_rng(0)))
        shown.append(demonstrator.preferences(histories(road, cars))[0])
    assert [row.argmax() for row in shown] == [good] * 3
    assert np.array_equal(shown[0], shown[2])
