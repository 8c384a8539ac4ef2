"""The rules of the lawful car: each limits the acceleration, the smallest is driven and reported."""

from __future__ import annotations

import math
from collections.abc import Iterator

import libsumo
import pytest
from conftest import Start, vehicle

from cosim.control import courtesy
from cosim.simulation.lawful import leader
from cosim.simulation.sumo import SumoSimulator
from cosim.types import Command, Preset, Snapshot

RAMP = '<route id="ramp" edges="ramp main_acc main_out"/>'


class Shown(SumoSimulator):
    """Drives a human by hand, tells how courteous a driver is, and may look at the leader alone."""

    def slow_down(self, name: str, speed: float) -> None:
        libsumo.vehicle.setSpeedMode(name, 0)
        libsumo.vehicle.slowDown(name, speed, 3.0)

    def courtesy_of(self, name: str) -> float:
        return float(libsumo.vehicle.getParameter(name, "laneChangeModel.lcCooperative"))

    def be(self, courteous: float) -> None:
        self.courtesy = courteous

    def see_leader_alone(self) -> None:
        leader.VEHICLES_BEYOND_LEADER = 0


def driven(worker: object, *avs: str, decisions: int = 30) -> Iterator[Snapshot]:
    """The frames of AVs that ask for more speed."""
    for _ in range(decisions):
        yield from worker.call("advance", [Command(av, 30.0, 0, 0.4) for av in avs])[1]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("degrees", "found"), [(-30.0, 0.0), (0.0, 0.0), (22.5, 0.414), (45.0, 1.0), (90.0, 1.0), (120.0, 1.0)]
)
def test_courtesy_is_the_weight_of_others_as_a_share_of_ones_own(degrees: float, found: float) -> None:
    assert courtesy(math.radians(degrees)) == pytest.approx(found, abs=1e-3)


def slowest(start: Start, courteous: float) -> float:
    """m/s of a human beside an AV, whose lane ends."""
    human = '<vehicle id="human" type="hv" route="ramp" depart="0" departPos="410" departSpeed="20"/>'
    ahead = vehicle("ahead", "hv", 495.0, speed=20.0, more='speedFactor="0.8"')
    row = [ahead, vehicle("av", "av", 465.0), vehicle("behind", "av", 440.0)]
    worker = start([RAMP, human, *row], simulator=Shown, preset=Preset.LAWFUL)
    worker.call("be", courteous)
    worker.call("reset", 0)
    frames = list(driven(worker, "av", "behind", decisions=40))
    return min(float(frame.speed[frame.row["human"]]) for frame in frames[10:])


def test_it_lets_a_human_in_whose_lane_ends_if_phi_says_so(start: Start) -> None:
    assert slowest(start, 1.0) > slowest(start, 0.0) + 10.0


def test_between_0_and_1_a_share_of_the_avs_is_courteous_in_full(start: Start) -> None:
    avs = [f"av{number}" for number in range(20)]
    worker = start(
        [vehicle(av, "av", 30.0 * number) for number, av in enumerate(avs)],
        simulator=Shown,
        preset=Preset.LAWFUL,
    )
    courteous = []
    for share in (0.3, 0.6):
        worker.call("be", share)
        worker.call("reset", 0)
        worker.call("advance", [Command(av, 20.0, 0, 0.4) for av in avs])
        courteous.append({av for av in avs if worker.call("courtesy_of", av)})
        assert all(worker.call("courtesy_of", av) == 1.0 for av in courteous[-1])
    assert 0 < len(courteous[0]) < len(courteous[1]) < len(avs)
    assert courteous[0] < courteous[1]


def test_it_is_courteous_only_while_it_is_commanded(start: Start) -> None:
    worker = start([vehicle("av", "av", 0.0)], simulator=Shown, preset=Preset.LAWFUL)
    before = worker.call("courtesy_of", "av")
    worker.call("advance", [Command("av", 20.0, 0, 0.4)])
    assert (before, worker.call("courtesy_of", "av")) == (0.0, 1.0)
    worker.call("advance", [])
    assert worker.call("courtesy_of", "av") == before


def hardest(start: Start, beyond: bool) -> float:
    """m/s2, the hardest braking behind a human who brakes late for the one ahead of it."""
    row = [
        vehicle("first", "hv", 220.0, speed=20.0),
        vehicle("leader", "late", 190.0, speed=20.0),
        vehicle("av", "av", 165.0, speed=20.0),
    ]
    late = (
        '<vType id="late" length="5" width="2" carFollowModel="IDM" tau="0.3" minGap="1" accel="3" decel="9" '
        'emergencyDecel="9" sigma="0" speedDev="0" lcKeepRight="0" lcSpeedGain="0"/>'
    )
    worker = start([late, *row], simulator=Shown, preset=Preset.LAWFUL)
    if not beyond:
        worker.call("see_leader_alone")
    worker.call("slow_down", "first", 4.0)
    return -min(float(frame.accel[frame.row["av"]]) for frame in driven(worker, "av", decisions=14))


def test_it_brakes_gently_for_what_begins_beyond_its_leader(start: Start) -> None:
    gentle, late = hardest(start, beyond=True), hardest(start, beyond=False)
    assert gentle < late - 0.4


def test_the_reason_is_that_of_the_smallest_limit(start: Start) -> None:
    row = [vehicle("first", "hv", 280.0, speed=20.0), vehicle("leader", "hv", 240.0, speed=20.0)]
    worker = start([*row, vehicle("av", "av", 165.0, speed=20.0)], simulator=Shown, preset=Preset.LAWFUL)
    worker.call("slow_down", "first", 2.0)
    reasons = [one.reason for frame in driven(worker, "av") for one in frame.events.interventions]
    assert reasons[0] == "traffic ahead"
