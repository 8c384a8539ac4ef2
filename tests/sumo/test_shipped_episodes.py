"""The episodes that come with the result pages are those that this code drives (`make audit` drives more)."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.papers import episodes, shipped
from benchmarks.papers.agents import missing
from benchmarks.papers.driving import Settings
from benchmarks.papers.jobs import JOBS
from benchmarks.papers.pages import Job
from cosim.errors import BadInput

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / shipped.FOLDER
PAGES = ROOT / "docs" / "results"
HELD = [
    job
    for job in JOBS
    if "--held`" in (PAGES / f"{job.name}.md").read_text(encoding="utf-8")
    and not any(missing(order.agent) for order in job.orders())
]


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


@pytest.mark.parametrize("job", HELD, ids=lambda job: job.name)
def test_a_page_of_what_was_driven_is_the_page_of_the_shipped_episodes(job: Job, tmp_path: Path) -> None:
    out = tmp_path / "pages"
    settings = Settings(runs=tmp_path / "runs", out=out, shipped=FOLDER, held=True)
    job.make(settings)
    if not (out / f"{job.name}.md").exists():
        pytest.skip("other versions of the packages take no shipped episodes")
    for name in (f"{job.name}.md", f"data/{job.name}.csv"):
        assert (out / name).read_text() == (PAGES / name).read_text()


def test_they_are_of_an_unguarded_fleet_without_anything_of_a_machine() -> None:
    run = shipped.episodes(FOLDER)
    assert min(row["seed"] for row in run.rows) >= 100_000  # training seeds are none of them
    assert {row["preset"] for row in run.rows} == {"unguarded"}
    assert {row["status"] for row in run.rows} == {"ok"}
    assert not {"timings", "total_s"} & set(run.rows[0])
    assert '"/' not in (FOLDER / shipped.MANIFEST).read_text()  # no path of whoever drove them


def test_what_collisions_tell_today_besides_is_no_difference() -> None:
    row = {"key": "k", "policy": "p", "scenario": "w", "demand": "d", "seed": 1, "status": "ok"}
    before = row | {"collision_list": '[{"collider": "a", "victim": "b"}]'}
    today = row | {"collision_list": '[{"collider": "a", "victim": "b", "human_error_involved": false}]'}
    other = row | {"collision_list": '[{"collider": "b", "victim": "a", "human_error_involved": false}]'}
    assert episodes._differences(before, today) == []
    assert len(episodes._differences(before, other)) == 1
    assert len(episodes._differences(before, row | {"collision_list": "[]"})) == 1
