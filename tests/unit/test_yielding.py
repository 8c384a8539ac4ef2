"""The search over scripted yielding: its constants exist, the rule is paired with the car road by road."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from benchmarks import yielding
from cosim.seeding import TUNING_SEEDS
from sumo_scenarios.draw import draw
from sumo_scenarios.full_roads import FULL, LARGEST, FullRoad, full_roads


def test_each_habit_is_a_constant_of_the_rule_and_is_driven_alone() -> None:
    rule = importlib.import_module(yielding.RULE)
    assert all(isinstance(getattr(rule, constant), bool) for constant in yielding.HABITS.values())
    road = FullRoad(100_000, "weave", Path("weave"))
    alone = yielding.case("yields at lines only", road, None)
    assert alone.options["policy"] == "yield-rule"
    assert alone.constants == {f"{yielding.RULE}.EASES_OFF": False, f"{yielding.RULE}.YIELDS_AT_LINES": True}
    assert yielding.case("`yield-rule`", road, None).constants == {}


def rows(driver: str, delay: float, roads: int) -> list[yielding.Drive]:
    return [
        yielding.Drive(driver, "weave", seed, delay * seed, delay * seed, 0, 10)
        for seed in range(100_000, 100_000 + roads)
    ]


@pytest.mark.parametrize(
    ("delay", "roads", "answer"),
    [
        (0.8, yielding.FEWEST, "**Yes.** `yield-rule` changes everybody's delay by -20"),
        (1.1, yielding.FEWEST, "**No gain is shown.** `yield-rule` changes everybody's delay by 10"),
        (0.8, 3, "**Not decided:** 3 roads are too few."),
    ],
)
def test_the_rule_is_compared_with_the_car_on_the_same_roads(delay: float, roads: int, answer: str) -> None:
    text = "\n".join(
        yielding.page([*rows(yielding.CAR, 1e-3, roads), *rows("`yield-rule`", delay / 1e3, roads)])
    )
    assert answer in text
    assert ("It costs 10 (10 to 10) % on `weave` roads." in " ".join(text.split())) == (delay > 1.0)
    assert f"| `weave` | {roads} | 100.0 s | {100 * delay:.1f} s | {100 * delay - 100:.0f}" in text


def test_what_a_search_found_is_compared_with_the_rule() -> None:
    driven = [*rows(yielding.CAR, 1e-3, 24), *rows("`yield-rule`", 0.8e-3, 24)]
    assert "`altruist` has not been driven." in "\n".join(yielding.page(driven))
    for delay, found in (
        (0.6, "found better ones: `altruist` changes everybody's delay by -25"),
        (0.9, "no better ones"),
    ):
        text = " ".join(yielding.page([*driven, *rows("`altruist`", delay / 1e3, 24)]))
        assert found in text


def test_the_roads_are_full_and_small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("sumo_scenarios.full_roads.write", lambda seed, folder: folder / str(seed))
    roads = [*full_roads(2, tmp_path, ("weave", "minor"))]
    assert sorted(road.kind for road in roads) == ["minor", "minor", "weave", "weave"]
    for road in roads:
        drawn = draw(road.seed)
        assert road.seed in TUNING_SEEDS
        assert drawn.level >= FULL
        assert drawn.per_hour <= LARGEST
