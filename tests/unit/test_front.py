"""The front of delay and safety: constants of the car exist, habits are summed up road by road."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from benchmarks import drives, front


def row(habit: str, errors: str, seed: int, delay: float, hits: int) -> front.Drive:
    return front.Drive(habit, errors, seed, delay, hits, hits // 2, 500.0, 100)


@pytest.mark.parametrize("habit", [habit for habit in front.HABITS.values() if habit.constants])
def test_the_constants_that_are_changed_are_the_cars(habit: front.Habit) -> None:
    for constant, value in habit.constants.items():
        module, _, name = constant.partition(".")
        now = getattr(importlib.import_module(f"{front.RULES}.{module}"), name)
        assert type(now) is type(value)
        assert now != value


def test_delays_are_of_errors_field_and_collisions_of_stress(tmp_path: Path) -> None:
    rows = []
    for seed, delay in ((1, 30.0), (2, 50.0)):
        rows += [row(front.CAR, "field", seed, delay, 0), row(front.CAR, "stress", seed, 900.0, 4)]
        rows += [row("`idm`", "field", seed, 2 * delay, 0), row("`idm`", "stress", seed, 900.0, 4)]
    car, idm = front.points([*rows, row("no AVs", "field", 1, 9.0, 0)])
    assert (car.delay, idm.delay, idm.change.value) == (40.0, 80.0, 1.0)
    assert car.hit.value == pytest.approx(8 / 1.0)
    assert car.hit.low < 8.0 < car.hit.high
    assert (car.caused, car.brakings) == (4, pytest.approx(0.2))
    drives.write(tmp_path / "rows.csv", front.Drive._fields, rows)
    assert drives.read(front.Drive, tmp_path / "rows.csv") == rows
    front.picture(rows, tmp_path / "front.svg")
    assert "| the car | 40.0 |  | 8 (" in "\n".join(front.page(rows))
