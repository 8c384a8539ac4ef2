"""Who is to blame: the lane changes of AVs that SUMO drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from policy_scenes import straight_road

from cosim.simulation.collisions import CUT_IN_WINDOW, CollisionDetector, _collision
from cosim.simulation.commands import Commander, Controlled
from cosim.simulation.convert import Body
from cosim.types import NO_EVENTS, Kind, Snapshot

ROAD = straight_road(3)
NAMES = ("av", "commanded", "hv")
BODIES = {name: Body(Kind.HV if name == "hv" else Kind.AV, False, 5.0, 2.0) for name in NAMES}


def seen(time: float, lanes: Sequence[int]) -> Snapshot:
    n = np.zeros(3)
    kind = np.array([BODIES[name].kind for name in NAMES], np.int8)
    return Snapshot(
        time, NAMES, kind, n > 0, n, n, n, n, n, n + 5.0, n + 2.0, np.array(lanes, np.int32), n, NO_EVENTS
    )


def test_a_lane_change_is_noted_of_an_av_that_sumo_drives_and_of_nobody_else() -> None:
    detector, commander = CollisionDetector(), Commander("unguarded", 0.1)
    commander.controlled["commanded"] = Controlled(20.0)
    for time, lanes in ((0.2, (0, 0, 0)), (0.4, (1, 1, 1)), (0.6, (1, 1, 1)), (0.8, (-1, 1, 1))):
        detector.lane_changes(seen(time, lanes), ROAD, commander)
    assert commander.lane_changes == {"av": 0.4}
    detector.lane_changes(seen(1.0, (2, 1, 1)), ROAD, commander)
    assert commander.lane_changes == {"av": 0.4}, "it was nowhere: that is no lane change"
    detector = CollisionDetector()  # a new episode
    detector.lane_changes(seen(1.2, (0, 1, 1)), ROAD, commander)
    assert commander.lane_changes == {"av": 0.4}


def test_hit_from_behind_it_is_to_blame_while_the_window_lasts() -> None:
    changes = {"av": 10.0, "hv": 10.0}

    def caused(now: float, collider: str, victim: str) -> bool:
        return _collision(now, collider, victim, "", "sumo", "", 0.0, 0.0, BODIES, changes).av_caused

    assert caused(10.0 + CUT_IN_WINDOW, "hv", "av")
    assert not caused(10.1 + CUT_IN_WINDOW, "hv", "av")
    assert caused(99.0, "av", "hv")
