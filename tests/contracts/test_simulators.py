"""SUMO and the shipped fake keep the same contract."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import TYPES, vehicle
from simulator_contract import Here, Probe, SimulatorContract, World

from cosim.scenario import Fleet, Mission, Scenario, load
from cosim.simulation.fake import FakeSimulator, FakeVehicle
from cosim.workers.worker import Worker


class TestFake(SimulatorContract):
    @pytest.fixture
    def world(self) -> World:
        vehicles = [
            FakeVehicle("a", 300.0, 0, 20.0, is_av=True),
            FakeVehicle("h", 150.0, 0, 20.0, desired=20.0),
            FakeVehicle("w", 520.0, 0, 0.0, desired=0.01),
        ]
        return Here(Probe(FakeSimulator(vehicles)))


def sumo(scenario: Scenario) -> Probe:
    """Built in the worker: libsumo is imported there."""
    from cosim.simulation.sumo import SumoSimulator

    return Probe(SumoSimulator(scenario))


@pytest.fixture(scope="module")
def sumo_worker() -> Iterator[list[Worker]]:
    """One SUMO process for all the tests, until one of them closes it."""
    workers: list[Worker] = []
    yield workers
    for worker in workers:
        worker.close()


class TestSumo(SimulatorContract):
    @pytest.fixture
    def world(self, sumo_worker: list[Worker], tmp_path: Path) -> Iterator[World]:
        if not sumo_worker:
            demand = tmp_path / "two.rou.xml"
            vehicles = [
                vehicle("a", "av", 300.0),
                vehicle("h", "hv", 150.0).replace('departSpeed="20.0"', 'departSpeed="random"'),
                vehicle("w", "hv", 520.0, speed=0.0, more='speedFactor="0.001"'),
            ]
            demand.write_text(TYPES + "\n".join(vehicles) + "</routes>")
            scenario = replace(
                load("merge", preset="unguarded"),
                demand=(demand,),
                warmup=0.4,
                behavior="as-is",
                mission=Mission(kind="none"),
                fleet=Fleet(type="av"),
                options=(("insertion-checks", "none"), ("extrapolate-departpos", "false")),
            )
            sumo_worker.append(Worker(sumo, scenario, timeout=60.0))
        yield sumo_worker[0]
        if sumo_worker[0].call("is_closed"):
            sumo_worker.pop().close()
