"""Nothing lies in docs/results that no command makes, and every picture that is shown is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import learning, measured
from benchmarks.tables import READ, marks, write_page
from research import figure8, schema

RESULTS = Path(__file__).parents[2] / measured.RESULTS

CLAIMS = schema.names()  # one that is not driven yet has no data
OWN_COMMANDS = ("driver_errors.md",)  # docs/guides/reproduction.md


def test_every_page_figure_and_picture_of_the_results_is_made_by_make_results() -> None:
    driven = [name for name in (*CLAIMS, figure8.NAME) if (RESULTS / "data" / f"{name}.csv").is_file()]
    driven += [learning.NAME]
    pages = {f"{name}.md" for name in driven} | {"README.md", *OWN_COMMANDS}
    pages |= {file for page in measured.PAGES for file in page.files if file.endswith(".md")}
    tables = {f"data/{name}.csv" for name in driven}
    tables |= {file for page in measured.PAGES for file in page.files if file.endswith(".csv")}
    shown = {
        picture
        for page in RESULTS.glob("*.md")
        for picture in re.findall(r"\]\(([^)]+\.(?:png|svg))\)", page.read_text())
    }
    files = {str(path.relative_to(RESULTS)) for path in RESULTS.rglob("*") if path.is_file()}
    files = {file for file in files if not file.startswith(("trainings/", "episodes/"))}
    assert files - tables - shown == pages
    assert tables <= files
    assert shown <= files


def test_what_a_person_read_in_a_page_survives_the_page_made_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    write_page(page, ["# A page", "", "1 of 2.", "", "## More", "", "old"])
    begin, end = marks(READ)
    page.write_text(page.read_text().replace("## More", f"{begin}\nIt is the car.\n{end}\n\n## More"))
    write_page(page, ["# A page", "", "2 of 2.", "", "## More", "", "new"])
    assert page.read_text() == (f"# A page\n\n2 of 2.\n\n{begin}\nIt is the car.\n{end}\n\n## More\n\nnew\n")
    assert "still holds" in capsys.readouterr().err
