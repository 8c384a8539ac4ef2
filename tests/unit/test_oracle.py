"""What the oracle makes of the frames that come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from policy_scenes import Car, histories, straight_road

from cosim.types import NO_EVENTS, Snapshot
from policy.agents.oracle import coming
from policy.inputs.scene import join


def test_who_has_left_goes_straight_on_on_an_empty_road_too() -> None:
    road = straight_road(2, dead_end=0, at=500.0)
    scene = join(histories(road, [Car("a", 300.0, 1, 20.0, is_av=True)]), True)
    nobody = np.zeros(0)
    none = np.zeros(0, np.bool_)
    empty = Snapshot(
        *(0.2, (), np.zeros(0, np.int8), none, *[nobody] * 7, np.zeros(0, np.int32), nobody, NO_EVENTS)
    )
    states = coming(scene, [empty, replace(empty, time=0.4)], 0.2)
    row = scene.vehicles.index("a")
    speed = scene.state[row, -1, 2]
    assert np.allclose(np.diff(states[row, :, 0]), 0.2 * speed)
