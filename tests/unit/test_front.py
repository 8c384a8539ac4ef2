"""The front of delay and safety: constants of the car exist, habits are summed up road by road."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from benchmarks import drives, front


def row(habit: str, road: str, errors: str, seed: int, delay: float, hits: int) -> front.Drive:
    return front.Drive(habit, road, errors, seed, delay, hits, hits // 2, 500.0, 100)


@pytest.mark.parametrize("habit", [habit for habit in front.HABITS.values() if habit.constants])
def test_the_constants_that_are_changed_are_the_cars(habit: front.Habit) -> None:
    for constant, value in habit.constants.items():
        module, _, name = constant.partition(".")
        now = getattr(importlib.import_module(f"{front.RULES}.{module}"), name)
        assert type(now) is type(value)
        assert now != value


def test_delays_are_of_errors_field_and_collisions_of_stress(tmp_path: Path) -> None:
    rows = []
    for road, delay in (("lane_drop", 30.0), ("on_ramp", 50.0)):
        for seed in (1, 2):
            rows += [row(front.CAR, road, "field", seed, delay + seed, 0)]
            rows += [row(front.CAR, road, "stress", seed, 900.0, 4)]
    (point,) = front.points([*rows, row("`idm`", "lane_drop", "field", 1, 9.0, 0)])
    assert point.delays == (31.5, 51.5)
    assert point.hit.value == pytest.approx(16 / 2.0)
    assert point.hit.low < 8.0 < point.hit.high
    assert (point.caused, point.brakings) == (8, pytest.approx(0.2))
    drives.write(tmp_path / "rows.csv", front.Drive._fields, rows)
    assert drives.read(front.Drive, tmp_path / "rows.csv") == rows
    front.picture(rows, tmp_path / "front.svg")
    assert "| the car | 31.5 | 51.5 | 8 (" in "\n".join(front.page(rows))
