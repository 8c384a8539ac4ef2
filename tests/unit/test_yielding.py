"""The search over scripted yielding: its constants exist, rules are paired with the car road by road."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from benchmarks import yielding
from benchmarks.full_roads import FULL, LARGEST, full_roads
from cosim.seeding import TUNING_SEEDS
from sumo_scenarios.draw import draw


@pytest.mark.parametrize("changed", [constants for constants in yielding.RULES.values() if constants])
def test_the_constants_that_are_changed_are_the_rules(changed: dict[str, object]) -> None:
    rule = importlib.import_module(yielding.RULE)
    for name, value in changed.items():
        assert type(getattr(rule, name)) is type(value)
        assert getattr(rule, name) != value


def row(driver: str, seed: int, delay: float) -> yielding.Drive:
    return yielding.Drive(driver, "weave", seed, delay, delay, 0, 10)


def test_a_rule_is_compared_with_the_car_on_the_roads_that_both_drove() -> None:
    rows = [row(yielding.CAR, seed, 50.0 + seed) for seed in range(8)]
    rows += [row("as it ships", seed, 0.8 * (50.0 + seed)) for seed in range(6)]
    text = "\n".join(yielding.page([*rows, row("for 15 s", 99, 1.0)]))
    assert "| weave | 6 | as it ships | 52.5 | 42.0 | -20 (-20 to -20) % |" in text
    assert "for 15 s" not in text
    assert "**Yes:** everybody's delay falls with: as it ships." in text


def test_the_roads_are_full_and_small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("benchmarks.full_roads.write", lambda seed, folder: folder / str(seed))
    roads = [*full_roads(2, tmp_path, ("weave", "minor"))]
    assert sorted(road.kind for road in roads) == ["minor", "minor", "weave", "weave"]
    for road in roads:
        drawn = draw(road.seed)
        assert road.seed in TUNING_SEEDS
        assert drawn.level >= FULL
        assert drawn.per_hour <= LARGEST
