"""Shared by all tests: SUMO worlds of a few vehicles, each simulation in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cosim.scenario import Fleet, Mission, Scenario, load
from cosim.simulation.sumo import SumoSimulator
from cosim.workers import worker as workers
from cosim.workers.worker import Worker
from tests.service.servers import Server
from tests.worlds.build import build

TYPES = """<routes>
    <vType id="hv" length="5" width="2" carFollowModel="IDM" tau="1" minGap="2" accel="3" decel="7"
           emergencyDecel="9" sigma="0" speedDev="0" lcKeepRight="0" lcSpeedGain="0" lcCooperative="0"
           lcStrategic="1"/>
    <vType id="av" length="5" width="2" carFollowModel="IDM" tau="0.8" minGap="2" accel="3" decel="7"
           emergencyDecel="9" sigma="0" speedDev="0" lcKeepRight="0" lcCooperative="0"/>
    <route id="main" edges="main_in main_acc main_out"/>
"""

Start = Callable[..., Worker]


def vehicle(name: str, kind: str, x: float, lane: int = 0, speed: float = 20.0, more: str = "") -> str:
    """One vehicle on the merge world's main road, its front bumper `x` m after the start."""
    return (
        f'<vehicle id="{name}" type="{kind}" route="main" depart="0" departPos="{x}" departLane="{lane}" '
        f'departSpeed="{speed}" {more}/>'
    )


@pytest.fixture(scope="session", autouse=True)
def forked_workers() -> Iterator[None]:
    """Workers fork from a process that has loaded SUMO and torch: 0.2 s of a core a start, not 0.9 to 3.

    Where a test changes the environment or the streams, they are spawned as a user's are; so are those of
    every `cosim` that a test runs as a program, and those of batches, which end with the process that started
    them (`cosim.workers.supervisor`).
    """
    spawn, fork = workers._CONTEXT, multiprocessing.get_context("forkserver")
    fork.set_forkserver_preload(["tests.forked"])
    begun_with = surroundings()

    class Context:
        Pipe = spawn.Pipe

        @staticmethod
        def Process(**options: Any) -> multiprocessing.process.BaseProcess:
            alone = options["name"] == "cosim-evaluation" or surroundings() != begun_with
            return (spawn if alone else fork).Process(**options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "_CONTEXT", Context)
        yield


def surroundings() -> tuple[dict[str, str], list[int]]:
    """The environment, without what pytest itself changes in it, and the files behind stdout and stderr."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    return environment, [os.fstat(stream).st_ino for stream in (1, 2)]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """`start(vehicles, preset=...)`: a worker that holds a SumoSimulator (or another `simulator`) with just
    these vehicles."""
    begun: list[Worker] = []

    def begin(vehicles: list[str], simulator: type = SumoSimulator, **changes: object) -> Worker:
        demand = tmp_path / f"demand{len(begun)}.rou.xml"
        demand.write_text(TYPES + "\n".join(vehicles) + "</routes>")
        scenario: Scenario = replace(
            load("merge"),
            demand=(demand,),
            preset="unguarded",
            warmup=0.1,
            behavior="as-is",
            mission=Mission(kind="none"),
            fleet=Fleet(type="av"),
            options=(("insertion-checks", "none"), ("extrapolate-departpos", "false")),
        )
        scenario = replace(scenario, **changes)  # type: ignore[arg-type]
        worker = Worker(simulator, scenario, timeout=60.0)
        begun.append(worker)
        worker.call("reset", 0)
        return worker

    yield begin
    for worker in begun:
        worker.close()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """`cosim serve` with two workers, without a token; for tests that leave it as they found it."""
    with Server(tmp_path_factory.mktemp("service") / "data", "--workers", "2") as running:
        running.warm()
        yield running


@pytest.fixture(scope="session")
def law_worlds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The worlds of tests/worlds, built once: name -> .sumocfg."""
    return build(tmp_path_factory.mktemp("worlds"))
