"""The result pages that no driven episodes make, each rebuilt in small; nothing else lies in docs/results."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import measured
from benchmarks.papers import learning
from benchmarks.papers.jobs import JOBS

RESULTS = Path(__file__).parents[2] / measured.RESULTS


@pytest.mark.parametrize("page", measured.PAGES, ids=lambda page: page.name)
def test_every_measured_page_is_rebuilt_and_not_measured_twice(
    page: measured.Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = measured.Place(tmp_path / "pages", tmp_path / "work", small=True)
    assert measured.make(page, place)
    for file in page.files:
        assert (place.out / file).stat().st_size > 200
    assert (place.out / page.files[0]).read_text().startswith("# ")
    monkeypatch.setattr(measured.subprocess, "run", lambda *_, **__: pytest.fail("measured twice"))
    assert not measured.make(page, place)
    (place.out / page.files[0]).unlink()
    with pytest.raises(pytest.fail.Exception, match="measured twice"):
        measured.make(page, place)


AMONG_HUMANS = ("humans.md", "turn_stress.md")  # by commands of their own: docs/reproduction.md


def test_every_page_figure_and_picture_of_the_results_is_made_by_make_results() -> None:
    driven = [job.name for job in JOBS] + [learning.NAME]
    pages = {f"{name}.md" for name in driven} | {"README.md", *AMONG_HUMANS}
    pages |= {file for page in measured.PAGES for file in page.files if file.endswith(".md")}
    tables = {f"data/{name}.csv" for name in (*driven, "avoidable", "turn_stress")}
    tables |= {file for page in measured.PAGES for file in page.files if file.endswith(".csv")}
    shown = {
        str((page.parent / picture).relative_to(RESULTS))
        for page in (*RESULTS.glob("*.md"), *RESULTS.glob("uses/*.md"))
        for picture in re.findall(r"\]\(([^)]+\.(?:png|svg))\)", page.read_text())
    }
    files = {str(path.relative_to(RESULTS)) for path in RESULTS.rglob("*") if path.is_file()}
    files = {file for file in files if not file.startswith(("trainings/", "episodes/", "data/real_nets/"))}
    assert files - tables - shown == pages
    assert tables <= files
    assert shown <= files
