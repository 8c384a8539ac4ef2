"""Other TraCI programs in the same simulation, both ways: their presence changes nothing, ends are clear."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import sumo_scenarios
from tests.worlds.build import build

# A program against traci alone: PORT STEPS DEED. It steps along; after STEPS of its steps it does its deed.
OTHER = """
import os, signal, sys, traci
port, steps, deed = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
traci.init(port, numRetries=60)
traci.setOrder(1)
count = 0
while True:
    traci.simulationStep()
    count += 1
    if deed == "red" and count >= steps:
        for light in traci.trafficlight.getIDList():
            state = traci.trafficlight.getRedYellowGreenState(light)
            traci.trafficlight.setRedYellowGreenState(light, "r" * len(state))
    elif deed == "watch":
        for vehicle in traci.vehicle.getIDList():
            print(count, vehicle, traci.vehicle.getTypeID(vehicle), traci.vehicle.getSpeedMode(vehicle))
        sys.stdout.flush()
    elif deed == "slow" and count >= steps:
        for vehicle in traci.vehicle.getIDList():
            if traci.vehicle.getTypeID(vehicle).startswith("cosim.av."):
                traci.vehicle.setSpeed(vehicle, 1.0)
    elif count == steps and deed == "close":
        traci.close()
        break
    elif count == steps and deed == "die":
        os.kill(os.getpid(), signal.SIGKILL)
"""
ALL_RED = '''
from cosim.types import Metric


class AllRed:
    """The share of frames in which every signal is red."""

    def reset(self, snapshot, context):
        self.red = []

    def add(self, snapshot):
        self.red.append(bool((snapshot.signals == ord("r")).all()))

    def result(self):
        return {"all_red": Metric(sum(self.red) / len(self.red), "share", "")}
'''
DRIVE = ("--penetration", "0.3", "--policy", "random", "--duration", "20", "--json")
SEED = 5
LIMIT = 300  # s, of every wait: kernels may have to be compiled first

Command = list[str]


class Started(list[subprocess.Popen[str]]):
    """Programs that a test has started; none of them outlives it."""

    def run(self, *command: str) -> subprocess.Popen[str]:
        self.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return self[-1]

    def cosim(self, *arguments: str) -> subprocess.Popen[str]:
        return self.run(sys.executable, "-m", "cosim.cli.main", *arguments)

    def other(self, port: int, steps: int = 0, deed: str = "step") -> subprocess.Popen[str]:
        return self.run(sys.executable, "-c", OTHER, str(port), str(steps), deed)

    def sumo(self, world: str, port: int, clients: int = 1, types: bool = True) -> subprocess.Popen[str]:
        import sumo

        options = ["--remote-port", str(port), "--num-clients", str(clients), "--seed", str(SEED)]
        options += [
            "--lanechange.duration",
            "2",
            "--collision.action",
            "warn",
            "--collision.mingap-factor",
            "0",
        ]
        options += ["--additional-files", str(sumo_scenarios.TYPES)] if types else []
        binary = Path(sumo.__file__).parent / "bin" / "sumo"
        return self.run(str(binary), "-c", world, *options, "--no-step-log", "--no-warnings")


@pytest.fixture
def started() -> Iterator[Started]:
    programs = Started()
    yield programs
    for program in programs:
        program.kill()
        program.communicate()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A crossing with signals."""
    return str(build(tmp_path_factory.mktemp("worlds"), ["crossing_signals"])["crossing_signals"])


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number: int = probe.getsockname()[1]
    return number


def ended(program: subprocess.Popen[str], code: int = 0) -> tuple[str, str]:
    """Its stdout and stderr."""
    out, err = program.communicate(timeout=LIMIT)
    assert program.returncode == code, err
    return out, err


def document(program: subprocess.Popen[str], code: int = 0) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(ended(program, code)[0])
    return found


def both_ways(started: Started, world: str, steps: int, deed: str, *more: str) -> list[subprocess.Popen[str]]:
    """A drive that serves another program, and one that joins the same SUMO as another program."""
    first, second = free_port(), free_port()
    serving = ("run", world, "--seed", str(SEED), *DRIVE, "--traci-port", str(first))
    drives = [started.cosim(*serving, *more), started.cosim("join", f"localhost:{second}", *DRIVE, *more)]
    started.sumo(world, second, clients=2)
    for port in (first, second):
        started.other(port, steps, deed)
    return drives


def test_where_the_others_do_nothing_the_drive_is_the_same_both_ways(world: str, started: Started) -> None:
    drives = both_ways(started, world, 0, "step")
    alone = document(started.cosim("run", world, "--seed", str(SEED), *DRIVE))
    assert alone["dt_av_m"] is not None, "an AV drives"
    for found in map(document, drives):
        assert {**found, "timings": 0, "manifest": 0} == {**alone, "timings": 0, "manifest": 0}


def test_a_signal_that_another_program_switches_is_switched_for_our_agents(
    world: str, started: Started, tmp_path: Path
) -> None:
    file = tmp_path / "red.py"
    file.write_text(ALL_RED)
    drives = both_ways(started, world, 100, "red", "--metric", f"{file}:AllRed")
    served, joined = map(document, drives)
    assert served["all_red"] == joined["all_red"] == pytest.approx(0.5, abs=0.02)
    assert served["trace_hash"] == joined["trace_hash"]


def test_of_two_speeds_the_one_set_later_holds_and_the_other_is_said_to_be_refused(
    world: str, started: Started
) -> None:
    served, joined = map(document, both_ways(started, world, 100, "slow", "--policy", "keep-lane"))
    assert served["dt_av_m"] < 0.8 * joined["dt_av_m"], "who connects to us acts after us"
    assert served["commands_blocked"] > joined["commands_blocked"] + 10


@pytest.mark.parametrize("deed", ["close", "die"])
def test_the_other_s_end_ends_the_episode_and_is_said(world: str, started: Started, deed: str) -> None:
    served, joined = map(document, both_ways(started, world, 100, deed))
    words = (
        "the last TraCI program has left" if deed == "close" else "a TraCI program broke its connection off"
    )
    assert served["not_comparable_because"] == [f"ended after 10 s of 20 s: {words}"]
    assert served["steps"] == 25
    if deed == "close":  # SUMO goes on with us
        assert joined["steps"] == 50
    else:
        assert joined["not_comparable_because"] == ["ended after 9.6 s of 20 s: SUMO has gone"]


def test_who_does_not_come_or_cannot_come_in_is_said(world: str, started: Started) -> None:
    first, second = free_port(), free_port()
    waits = started.cosim("run", world, "--traci-port", str(first), "--traci-timeout", "3")
    nobody = started.cosim("join", f"localhost:{second}", "--timeout", "0.5")
    taken = free_port()
    started.sumo(world, taken, types=False)
    typeless = started.cosim("join", f"localhost:{taken}")
    assert f"port {first}: 1 TraCI program did not connect" in ended(waits, 3)[1]
    assert "no SUMO listens there" in ended(nobody, 2)[1]
    assert f"start SUMO with {sumo_scenarios.TYPES}" in ended(typeless, 2)[1]


def test_who_is_told_to_end_hands_its_vehicles_back(world: str, started: Started) -> None:
    port = free_port()
    started.sumo(world, port, clients=2)
    other = started.other(port, 0, "watch")
    joined = started.cosim("join", f"localhost:{port}", *DRIVE, "--duration", "600")
    assert other.stdout is not None
    seen = (line.split() for line in other.stdout)
    av = next(vehicle for _, vehicle, kind, mode in seen if kind.startswith("cosim.av."))
    joined.send_signal(signal.SIGTERM)
    assert document(joined, 130)["not_comparable_because"][0].endswith("of 600 s: interrupted")
    after = (words for words in seen if words[1] == av and not words[2].startswith("cosim.av."))
    assert next(after)[2:] == [f"DEFAULT_VEHTYPE@{av}", "31"]
