"""Small worlds without SUMO for the environments' tests: importable, so that a worker can build them."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace

from cosim.scenario import Mission, Scenario, load
from cosim.simulation.fake import FakeSimulator, FakeVehicle
from cosim.types import Command, Receipt, Snapshot


def scenario(duration: float = 4.0) -> Scenario:
    """The merge world's paperwork around a fake simulator; `duration` in s."""
    return replace(load("merge"), warmup=0.0, duration=duration, mission=Mission(kind="none"))


def platoon(*_: object) -> FakeSimulator:
    """Three AVs with room around them, and a human behind."""
    return FakeSimulator(
        [
            FakeVehicle("a", 300.0, 0, 20.0, is_av=True),
            FakeVehicle("b", 200.0, 0, 20.0, is_av=True),
            FakeVehicle("c", 250.0, 1, 20.0, is_av=True),
            FakeVehicle("human", 100.0, 0, 20.0, desired=20.0),
        ]
    )


def wall(*_: object) -> FakeSimulator:
    """AV `a` drives towards a standing human 30 m ahead; AV `b` is far away."""
    return FakeSimulator(
        [
            FakeVehicle("a", 100.0, 0, 20.0, is_av=True),
            FakeVehicle("b", 900.0, 1, 20.0, is_av=True),
            FakeVehicle("standing", 135.0, 0, 0.0, desired=0.01),
        ]
    )


def short_road(*_: object) -> FakeSimulator:
    """AV `a` leaves a road of 320 m after about a second; AV `b` stays."""
    return FakeSimulator(
        [FakeVehicle("a", 300.0, 0, 20.0, is_av=True), FakeVehicle("b", 100.0, 0, 20.0, is_av=True)],
        length=320.0,
    )


def nobody(*_: object) -> FakeSimulator:
    """Humans only."""
    return FakeSimulator([FakeVehicle("human", 100.0, 0, 20.0)])


class Hanging(FakeSimulator):
    """Never answers once it is driven."""

    def advance(self, commands: Sequence[Command]) -> tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]:
        time.sleep(60.0)
        return super().advance(commands)


class Dying(FakeSimulator):
    """Takes its process with it, as SUMO does on some nets."""

    def advance(self, commands: Sequence[Command]) -> tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]:
        os.abort()


def hanging(*_: object) -> FakeSimulator:
    """One AV in a world that hangs."""
    return Hanging([FakeVehicle("a", 100.0, 0, 20.0, is_av=True)])


def dying(*_: object) -> FakeSimulator:
    """One AV in a world whose simulation crashes."""
    return Dying([FakeVehicle("a", 100.0, 0, 20.0, is_av=True)])
