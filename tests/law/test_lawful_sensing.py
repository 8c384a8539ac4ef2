"""What the car of preset `lawful` does with what it knows, and does not know."""

from __future__ import annotations

import libsumo
import pytest
from conftest import Start, vehicle

from cosim.scenario.sensing import read
from cosim.simulation.sumo import SumoSimulator
from cosim.types import Command, Preset


class Stopping(SumoSimulator):
    """One human may be made to brake hard, or to change lanes."""

    def change(self, name: str) -> None:
        libsumo.vehicle.setSpeedMode(name, 0)
        libsumo.vehicle.setSpeed(name, 0.5)
        libsumo.vehicle.setLaneChangeMode(name, 0)
        libsumo.vehicle.changeLane(name, 1, 10.0)

    def brake(self, name: str) -> None:
        libsumo.vehicle.setSpeedMode(name, 0)
        libsumo.vehicle.slowDown(name, 0.0, 4.0)


def brakes_after(start: Start, sensing: str) -> float:
    """s after its leader from which an AV brakes."""
    pair = [vehicle("ahead", "hv", 150.0, speed=20.0), vehicle("av", "av", 110.0, speed=20.0)]
    worker = start(pair, simulator=Stopping, preset=Preset.LAWFUL, sensing=read(sensing))
    for _ in range(5):
        worker.call("advance", [Command("av", 20.0, 0, 0.4)])
    worker.call("brake", "ahead")
    frames = [f for _ in range(8) for f in worker.call("advance", [Command("av", 20.0, 0, 0.4)])[1]]
    assert not any(frame.events.collisions for frame in frames)
    began = frames[0].time - 0.2
    return float(next(f.time for f in frames if f.accel[f.row["av"]] < -1.0) - began)


def test_it_brakes_for_its_leader_as_late_as_it_knows(start: Start) -> None:
    at_once, late = (
        brakes_after(start, sensing) for sensing in ("ideal", "ideal,latency=0.8,compensation=cv")
    )
    assert 0.4 < late - at_once < 1.7  # the tracker's filter takes its time too


@pytest.mark.parametrize(
    ("sensing", "hits"),
    [
        ("ideal", False),
        ("ideal,range=120", False),
        ("ideal,range=2", True),  # it does not know of the one that stands there
        ("ideal,range=2,cam=true,equipped=1", False),  # that one says where it is
        ("ideal,range=2,cam=true", True),  # it is not equipped
    ],
)
def test_it_stops_for_one_that_stands_if_it_knows_of_it(start: Start, sensing: str, hits: bool) -> None:
    pair = [vehicle("ahead", "hv", 220.0, speed=0.0), vehicle("av", "av", 100.0, speed=20.0)]
    worker = start(pair, simulator=Stopping, preset=Preset.LAWFUL, sensing=read(sensing))
    worker.call("brake", "ahead")
    found = False
    for _ in range(30):
        frames = worker.call("advance", [Command("av", 20.0, 0, 0.4)])[1]
        found = found or any(c.collider_is_av for frame in frames for c in frame.events.collisions)
    assert found is hits


@pytest.mark.parametrize(
    ("sensing", "hits"), [("ideal", False), ("ideal,range=120", False), ("ideal,range=2", True)]
)
def test_it_brakes_for_one_that_is_coming_onto_its_lane(start: Start, sensing: str, hits: bool) -> None:
    pair = [vehicle("slow", "hv", 120.0, speed=0.1), vehicle("av", "av", 100.0, lane=1, speed=10.0)]
    worker = start(pair, simulator=Stopping, preset=Preset.LAWFUL, sensing=read(sensing))
    worker.call("change", "slow")
    found = False
    for _ in range(8):
        frames = worker.call("advance", [Command("av", 20.0, 0, 0.4)])[1]
        found = found or any(c.collider_is_av for frame in frames for c in frame.events.collisions)
    assert found is hits
