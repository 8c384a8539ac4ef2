"""The search over scripted yielding: its constants exist, rules are paired with the car road by road."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from benchmarks import yielding
from benchmarks.full_roads import FULL, LARGEST, full_roads
from cosim.seeding import TUNING_SEEDS
from sumo_scenarios.draw import draw


def test_each_habit_is_a_constant_of_the_rule() -> None:
    rule = importlib.import_module(yielding.RULE)
    assert all(isinstance(getattr(rule, constant), bool) for constant in yielding.HABITS.values())
    assert len(yielding.LETTERS) == len(yielding.HABITS)


@pytest.mark.parametrize("seed", range(100_000, 100_020))
def test_each_habit_is_on_in_two_of_four_different_combinations(seed: int) -> None:
    found = [*yielding.combinations(seed)]
    assert len(set(found)) == 4
    assert all(sum(letter in one for one in found) == 2 for letter in yielding.LETTERS)


def row(driver: str, seed: int, delay: float) -> yielding.Drive:
    return yielding.Drive(driver, "weave", seed, delay, delay, 0, 10)


def test_the_effect_of_a_habit_is_that_of_drives_with_and_without_it_on_the_same_road() -> None:
    rows = [
        row(driver, seed, (10.0 + seed) * (0.8 if "b" in driver else 1.0) * (1.1 if "d" in driver else 1.0))
        for seed in range(100_000, 100_030)
        for driver in yielding.combinations(seed)
    ]
    rows += [row(yielding.CAR, seed, 1.0) for seed in range(100_000, 100_030)]
    found = yielding.effects(rows)
    assert {letter: one.value for letter, one in found.items()} == pytest.approx(
        {"a": 0.0, "b": -0.2, "c": 0.0, "d": 0.1, "e": 0.0}, abs=1e-6
    )
    text = "\n".join(yielding.page([*rows, row("`idm`", 100_000, 1.5)]))
    assert "| `idm` | 1 | 1.5 | 50 % | 50 % | 10 | 0 |" in text
    assert "yields at lines saves delay" in text
    assert "**Not decided:** 2 roads are too few." in "\n".join(yielding.page(rows[:8]))


def test_the_roads_are_full_and_small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("benchmarks.full_roads.write", lambda seed, folder: folder / str(seed))
    roads = [*full_roads(2, tmp_path, ("weave", "minor"))]
    assert sorted(road.kind for road in roads) == ["minor", "minor", "weave", "weave"]
    for road in roads:
        drawn = draw(road.seed)
        assert road.seed in TUNING_SEEDS
        assert drawn.level >= FULL
        assert drawn.per_hour <= LARGEST
