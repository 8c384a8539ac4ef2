"""The code's shape, read from its source: one loop, one place that assembles it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# These time, one by one, the parts of the loop, of the simulator and of a decision.
MEASURE_PARTS = {f"benchmarks/{name}.py" for name in ("capacity", "decision_cost", "loop", "sensing_cost")}


def calls() -> Iterator[tuple[str, str]]:
    """(file, what is called) of every call in the packages, the claims, the benchmarks and the examples."""
    for package in ("cosim", "policy", "sumo_scenarios", "research", "benchmarks", "examples"):
        for file in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Call):
                    called = node.func
                    name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
                    yield file.relative_to(ROOT).as_posix(), name


@pytest.fixture(scope="module")
def callers() -> dict[str, set[str]]:
    """What is called -> the files that call it."""
    found: dict[str, set[str]] = {}
    for file, name in calls():
        found.setdefault(name, set()).add(file)
    return found


def test_only_the_loop_and_the_session_advance_an_episode(callers: dict[str, set[str]]) -> None:
    assert callers["advance"] - MEASURE_PARTS == {"cosim/episode.py", "cosim/envs/host.py"}


def test_one_place_assembles_simulator_and_episode(callers: dict[str, set[str]]) -> None:
    assert callers["SumoSimulator"] - MEASURE_PARTS == {"cosim/host.py"}
    assert callers["Episode"] == {"cosim/host.py"}


def test_whole_episodes_are_driven_by_the_one_loop(callers: dict[str, set[str]]) -> None:
    assert "cosim/host.py" in callers["run_episode"]
    assert not any(file.startswith("cosim/envs") for file in callers["run_episode"])
