"""Where drives turn with phi, and where their reward does."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.turn import (
    PHIS,
    Drive,
    break_even,
    columns,
    crossing,
    first_worth,
    read,
    table,
    turn,
    verdict,
    weights_of,
)
from cosim.files import write_csv


def drive(phi: float, seed: int, served: bool) -> Drive:
    own, others = (1.0, 1.0) if served else (2.0, 0.0)
    return Drive("x", "merge", phi, seed, served, 20.0 if served else 50.0, 500.0, 600.0, own, others, False)


DRIVES = [drive(phi, seed, phi >= (30.0 if seed % 2 else 45.0)) for phi in PHIS for seed in range(12)]


def test_the_reward_breaks_even_where_what_is_lost_weighs_as_much_as_what_is_gained() -> None:
    ends = np.zeros(len(PHIS) - 2)
    own, others = np.array([2.0, *ends, 1.0]), np.array([0.0, *ends, 1.0])
    assert break_even(own, others) == pytest.approx(45.0)
    assert break_even(own, 3.0 * others) == pytest.approx(math.degrees(math.atan(1 / 3)))
    assert math.isnan(break_even(own, -others)), "kindness that helps nobody"


def test_the_turn_is_where_half_of_the_change_is_reached() -> None:
    served = np.array([0.0, 0.0, 0.5, 1.0, 1.0, 1.0, 1.0])
    assert crossing(served) == pytest.approx((30.0, 45.0, 30.0))
    assert crossing(0.25 + 0.5 * served) == pytest.approx((30.0, 45.0, 30.0))
    assert math.isnan(crossing(served[::-1])[2])


def test_the_interval_of_the_turn_ends_at_driven_angles() -> None:
    """All seeds alike: it lies between 30 and 45 degrees, and nothing says where."""
    served = np.tile(np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]), (5, 1))
    found = turn(served)
    assert (found.low, found.value, found.high) == (30.0, 37.5, 45.0)


def test_the_way_that_is_worth_it_first_is_named() -> None:
    """At 45 degrees much is gained for little; at 90 more is lost."""
    own = np.array([1.0, 1.0, 1.0, 0.9, 0.9, 0.9, 0.1])
    others = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.9])
    least, driven = first_worth(own, others)
    assert least == pytest.approx(math.degrees(math.atan(0.1)))
    assert driven == 45.0
    assert all(math.isnan(x) for x in first_worth(own, 0.0 * others))


def test_a_page_compares_episodes_of_equal_seeds() -> None:
    alone = drive(0.0, 99, False)
    assert columns([*DRIVES, alone], "served").shape == (12, len(PHIS)), "driven at one phi alone"
    found = turn(columns(DRIVES, "served"))
    assert found.value == pytest.approx(30.0)
    assert found.low < 30.0 < found.high
    lines = table(DRIVES)
    assert len(lines) == 2 + len(PHIS)
    assert "| 0: 0 (0 to 24) % |" in lines[2].replace("| 0 | 12 | ", "| 0: ")
    assert "-15.0, 0." in lines[4], "half of the seeds turn at 30 degrees"
    assert "Turn 30 (" in verdict(DRIVES)
    assert "break-even of the reward 45 (45 to 45) degrees" in verdict(DRIVES)


def test_rows_say_which_weights_drove(tmp_path: Path) -> None:
    assert weights_of("idm") == ""
    assert len({weights_of(name) for name in ("vfn-p", "vfn", "safe-dqn")}) == 3
    driven = replace(DRIVES[0], weights=weights_of("vfn"))
    write_csv(tmp_path / "new.csv", [asdict(driven)])
    before = {k: v for k, v in asdict(driven).items() if k != "weights"}
    write_csv(tmp_path / "before.csv", [before])
    assert list(read(tmp_path / "new.csv").values()) == [driven]
    assert list(read(tmp_path / "before.csv").values()) == [replace(driven, weights="")]
