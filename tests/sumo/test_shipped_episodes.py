"""The episodes that come with the result pages are those that this code drives (`make audit` drives more)."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.papers import episodes, shipped
from benchmarks.papers.driving import Settings
from cosim.errors import BadInput

FOLDER = Path(__file__).parents[2] / shipped.FOLDER


def test_shipped_episodes_are_the_same_when_they_are_driven_anew() -> None:
    try:
        found = episodes.check(Settings(workers=1, shipped=FOLDER), 4)
    except BadInput as error:
        if "versions" in error.problem:
            pytest.skip(str(error))
        raise
    assert found.differing == ()
    assert found.driven == 4
    assert found.unknown == 0, "weights or worlds are new: make the pages anew, then `episodes keep`"


def test_they_are_of_an_unguarded_fleet_without_anything_of_a_machine() -> None:
    run = shipped.episodes(FOLDER)
    assert min(row["seed"] for row in run.rows) >= 100_000  # training seeds are none of them
    assert {row["preset"] for row in run.rows} == {"unguarded"}
    assert {row["status"] for row in run.rows} == {"ok"}
    assert not {"timings", "total_s"} & set(run.rows[0])
    assert '"/' not in (FOLDER / shipped.MANIFEST).read_text()  # no path of whoever drove them
