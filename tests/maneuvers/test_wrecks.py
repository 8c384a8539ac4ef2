"""An episode that goes on after a crash: the wrecks stand, others brake for them, and they are taken away."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Start, vehicle

from cosim.simulation.collisions import WRECK_DURATION
from cosim.types import INSERTION, Collision, Command, OnCollision, Preset, Receipt, Snapshot
from cosim.workers.worker import Worker

HOLD = 0.4  # s
STOPPED = vehicle("s", "hv", 190.0, speed=0.0).removesuffix("/>") + (
    '><stop lane="main_in_0" endPos="200" duration="1000"/></vehicle>'
)
RAM = [Command("a", 20.0, 0, HOLD)]


def drive(worker: Worker, commands: list[Command], decisions: int) -> tuple[list[Receipt], list[Snapshot]]:
    receipts, frames = [], []
    for _ in range(decisions):
        r, f = worker.call("advance", commands)
        receipts += r
        frames += f
    return receipts, frames


def collisions(frames: list[Snapshot]) -> list[Collision]:
    return [c for f in frames for c in f.events.collisions]


@pytest.mark.parametrize("preset", [Preset.UNGUARDED, Preset.LAWFUL])
def test_wrecks_stand_at_once_and_are_taken_off_the_road_after_some_seconds(
    start: Start, preset: str
) -> None:
    """In `lawful` the AV is put so close that nobody could brake for what stands there."""
    at, speed = (100.0, 20.0) if preset == Preset.UNGUARDED else (160.0, 25.0)
    ramming = vehicle("a", "av", at, speed=speed)
    worker = start([ramming, STOPPED], preset=preset, on_collision=OnCollision.CONTINUE)
    receipts, frames = drive(worker, RAM, 30)
    (crash,) = collisions(frames)
    assert {crash.collider, crash.victim} == {"a", "s"}
    after = [f for f in frames if f.time > crash.time + 0.21 and "a" in f.row]
    assert max(f.speed[f.row["a"]] for f in after) < 1e-9
    gone = next(f for f in frames if "a" not in f.row)
    assert gone.time - crash.time == pytest.approx(WRECK_DURATION, abs=0.21)
    assert [name for f in frames for name in f.events.wrecked] == ["a", "s"]
    assert sorted(name for f in frames for name in f.events.wrecks_removed) == ["a", "s"]
    assert not [name for f in frames for name in f.events.arrived], "who is taken away has not arrived"
    assert any(r.blocked == "crashed" for r in receipts)
    assert receipts[-1].blocked in ("not on the road", "crashed")


def test_others_brake_for_a_wreck_and_drive_on_when_it_is_gone(start: Start) -> None:
    beside = (
        STOPPED.replace('id="s"', 'id="t"')
        .replace("main_in_0", "main_in_1")
        .replace('departLane="0"', 'departLane="1"')
    )
    follower = vehicle("h", "hv", 80.0, speed=15.0)
    worker = start(
        [vehicle("a", "av", 130.0, speed=20.0), STOPPED, beside, follower],
        preset=Preset.UNGUARDED,
        on_collision=OnCollision.CONTINUE,
    )
    _, frames = drive(worker, RAM, 45)
    assert len(collisions(frames)) == 1
    speed = np.array([f.speed[f.row["h"]] for f in frames])
    assert speed.min() < 2.0
    assert speed[-1] > 4.0


def test_a_wreck_of_a_mobil_driver_stays_in_its_lane(start: Start) -> None:
    worker = start(
        [vehicle("a", "av", 100.0, speed=20.0), STOPPED],
        preset=Preset.UNGUARDED,
        on_collision=OnCollision.CONTINUE,
        behavior="aggressive",
        driver_model="mobil",
    )
    _, frames = drive(worker, RAM, 20)
    (crash,) = collisions(frames)
    y = [f.y[f.row["s"]] for f in frames if f.time > crash.time and "s" in f.row]
    assert np.ptp(y) == pytest.approx(0.0, abs=1e-9)


def test_cars_that_sumo_inserts_onto_one_another_drive_on(start: Start) -> None:
    inserted = vehicle("b", "hv", 103.0, speed=15.0)  # no insertion checks: 3 m before the other's front
    worker = start(
        [vehicle("a", "av", 100.0, speed=15.0), inserted],
        preset=Preset.UNGUARDED,
        on_collision=OnCollision.CONTINUE,
    )
    _, frames = drive(worker, [Command("a", 10.0, 0, HOLD)], 20)
    assert [c.kind for c in collisions(frames)] in ([INSERTION], []), (
        "or it was seen before the clock started"
    )
    assert frames[-1].n == 2
    assert frames[-1].speed.min() > 5.0
