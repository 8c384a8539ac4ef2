"""The report is one file that needs no other, shows NA as NA, and escapes names with markup."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from run_rows import CASE, begin, cell, failed, row, write

from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.report import html as report
from cosim.report.html import tables
from cosim.report.run_folder import read
from cosim.report.summary import GROUP

VOID = {"meta", "br", "link", "img", "hr", "input"}


class Page(HTMLParser):
    """Reads a page as a browser would, and complains about tags that are not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.words.append(" ".join(data.split()))

    @property
    def text(self) -> str:
        return " ".join(word for word in self.words if word)


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Page]:
    """Two policies, one with an SVO sweep, crashes, vetoes and a simulation that crashed."""
    spread = [700.0 + 10 * k for k in range(10)]
    hit = {"time": 12.3, "collider": "av.1", "victim": "hv.7", "av_caused": True, "lane": "a_0"}
    hit["human_error_involved"] = True
    crashed = {
        "crashed": [True] + [False] * 9,
        "av_caused_collisions": [1] + [0] * 9,
        "collision_list": [json.dumps([hit])] + ["[]"] * 9,
        "veto_rate": [0.1] * 9 + [None],
        "dt_av_m": spread,
        "min_ttc_s": [0.4, 0.9, *([None] * 8)],
        "near_misses_ttc": [3] * 10,
        "vehicle_hours": [0.3] * 10,
    }
    broken = replace(CASE, policy="vfn-p", svo_deg=90.0, seed=200_010)
    folder = write(
        tmp_path_factory.mktemp("report") / "run",
        cell("idm", 10, svo_deg=90.0, columns={"mission_success": [False] * 10, "dt_av_m": spread[::-1]}),
        [*cell("vfn-p", 10, svo_deg=90.0, columns=crashed), (broken, failed(broken))],
        cell("vfn-p", 10, svo_deg=0.0, columns={"policy_label": ["untrained"] * 10}),
    )
    return folder, Page(report.write(read(folder), shown="runs/my run").read_text())


def test_the_file_loads_nothing_from_anywhere(full: tuple[Path, Page]) -> None:
    folder, page = full
    text = (folder / "report.html").read_text()
    assert "default-src 'none'" in text
    for tag, attributes in page.tags:
        assert tag not in ("link", "img", "iframe", "object", "embed", "image")
        for name in ("src", "href", "xlink:href", "data", "action"):
            assert (attributes.get(name) or "#").startswith("#")
    assert not re.search(r"@import|url\((?!#)", text)


def test_figures_stand_with_intervals_and_counts(full: tuple[Path, Page]) -> None:
    text = full[1].text
    assert "10.0 % 1.8 to 40.4 1/10" in text  # Wilson of 1 in 10
    assert "below 30 % (3/n) 0/10" in text
    assert "mission success +100.0 pp" in text
    assert "10 of 11 1 sim_crash" in text
    assert "(untrained)" in text
    assert "TTC < 1.5 s per vehicle-hour" in text
    assert "10.0 6.7 to 14.3 30 in 3 h" in text  # Garwood: 20.2 to 42.8


def test_worst_episodes_come_with_their_replay_command(full: tuple[Path, Page]) -> None:
    text = full[1].text
    key = replace(CASE, policy="vfn-p", svo_deg=90.0).key
    assert "AV-caused collision at 12.3 s of SUMO's clock: av.1 hit hv.7, after a human error" in text
    assert f"cosim replay 'runs/my run' {key}" in text
    assert text.index("AV-caused collision at") < text.index("time to collision down to 0.90 s")


def test_a_crashed_simulation_is_listed_with_its_stderr(full: tuple[Path, Page]) -> None:
    text = full[1].text
    assert "Error: no such junction" in text
    assert "seed 200010" in text
    assert "1 of 31 episodes gave no figures" in text


def test_whatever_cells_share_has_a_title() -> None:
    assert {*GROUP} <= {*tables.TITLES}


def test_plots_take_the_theme_of_the_page(full: tuple[Path, Page]) -> None:
    folder, page = full
    drawings = [attributes for tag, attributes in page.tags if tag == "svg"]
    assert len(drawings) == 8
    assert all(d["viewbox"] and "width" not in d for d in drawings)
    text = (folder / "report.html").read_text()
    assert "var(--series-2)" in text
    assert not re.search(r"#0[1-4]0[0-9]0[0-9]", text)  # no stand-in colour is left
    for title in (
        "Episodes with a collision",
        "Smallest time to collision",
        "Distance of AVs and of the",
        "vetoed",
    ):
        assert title in page.text


def test_ids_in_the_page_refer_to_what_is_there(full: tuple[Path, Page]) -> None:
    ids = {a["id"] for _, a in full[1].tags if a.get("id")}
    wanted = {a["xlink:href"][1:] for _, a in full[1].tags if a.get("xlink:href")}
    assert wanted
    assert wanted <= ids


def test_tables_sort_by_number_and_na_sorts_last(full: tuple[Path, Page]) -> None:
    cells = [a["data-sort"] for tag, a in full[1].tags if "data-sort" in a]
    assert "0.1" in cells  # the crash rate itself, not "10.0 %"
    assert "" in cells


def test_the_same_run_gives_the_same_file(full: tuple[Path, Page]) -> None:
    written = (full[0] / "report.html").read_text()
    assert report.html(read(full[0]), "runs/my run") == written


def test_names_with_markup_are_escaped(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    case = replace(CASE, policy=evil, demand=(evil,))
    broken = {**failed(replace(case, seed=200_001)), "stderr": f"Error: {evil}", "demand": evil}
    driven = row(case, demand=evil, policy_label=evil, crashed=True)
    folder = write(tmp_path / "run", [(case, driven), (replace(case, seed=200_001), broken)])
    text = report.write(read(folder)).read_text()
    assert evil not in text
    assert sum(tag == "script" for tag, _ in Page(text).tags) == 1  # ours
    assert f"Error: {evil}" in Page(text).text


def test_a_run_without_any_figure_is_still_reported(tmp_path: Path) -> None:
    cases = [replace(CASE, seed=200_000 + k) for k in range(3)]
    folder = write(tmp_path / "run", [(c, failed(c, "timeout")) for c in cases])
    page = Page(report.write(read(folder)).read_text())
    assert "None of the 3 episodes gave figures" in page.text
    assert "0 of 3 3 timeout" in page.text
    assert not any(tag == "svg" for tag, _ in page.tags)


def test_a_run_that_lacks_episodes_says_so(tmp_path: Path) -> None:
    folder = write(tmp_path / "run", cell("idm", 2), cell("own", 1), planned=2)
    page = Page(report.write(read(folder)).read_text())
    assert "1 of 4 episodes not driven: `cosim evaluate --resume` continues" in page.text


def test_an_unfinished_run_is_reported_as_far_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = begin(tmp_path / "run", cell("idm", 2), cell("own", 1), planned=2)
    with pytest.raises(BadInput, match="is not finished: `cosim evaluate --resume --out"):
        read(folder)
    whole = read(write(tmp_path / "whole", cell("idm", 2), cell("own", 1), planned=2))
    assert read(folder, unfinished=True).rows == whole.rows
    assert main(["report", str(folder)]) == 0
    page = Page(Path(capsys.readouterr().out.strip()).read_text())
    assert "1 of 4 episodes not driven: `cosim evaluate --resume` continues" in page.text
    with pytest.raises(BadInput, match="has no episode yet"):
        read(begin(tmp_path / "empty", planned=2), unfinished=True)


def test_na_everywhere_is_shown_as_na(tmp_path: Path) -> None:
    names = ("crashed", "av_caused_collisions", "mission_success", "dt_mission_m", "dt_av_m", "dt_mean_m",
             "dt_hv_m", "min_ttc_s", "hard_brakings_av")  # fmt: skip
    folder = write(tmp_path / "run", cell("idm", 3, columns={name: [None] * 3 for name in names}))
    page = Page(report.write(read(folder)).read_text())
    headline = page.text[page.text.index("Tap a head") : page.text.index("Every figure")]
    assert headline.count("NA 3 NA") == 9
    assert "0.0 %" not in page.text


@pytest.mark.parametrize("count", [0, 1])
def test_runs_of_one_episode_or_none_are_reported(tmp_path: Path, count: int) -> None:
    folder = write(tmp_path / "run", cell("idm", count), manifest=count == 1)
    page = Page(report.write(read(folder)).read_text())
    assert ("Finished" if count else "No episodes") in page.text
    assert "holds no manifest.json" in page.text or count


def test_episodes_that_must_not_be_compared_are_said_with_the_reason(tmp_path: Path) -> None:
    columns = {"comparable": [False] * 2, "not_comparable_because": ['["7 vehicles found no room"]'] * 2}
    folder = write(tmp_path / "run", cell("idm", 2, columns=columns))
    text = Page(report.write(read(folder)).read_text()).text
    assert "2 not comparable" in text
    assert "2: n vehicles found no room" in text


def test_the_command_writes_the_report_and_refuses_other_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / "run", cell("idm", 1))
    assert main(["report", str(folder), "--out", str(tmp_path / "r.html")]) == 0
    assert (tmp_path / "r.html").read_text().startswith("<!doctype html>")
    capsys.readouterr()
    assert main(["report", str(tmp_path)]) == 2
    assert "has no episodes.parquet" in capsys.readouterr().err
    (folder / "episodes.parquet").write_bytes(b"PAR1 no parquet at all")
    assert main(["report", str(folder)]) == 2
    assert main(["report", str(folder), "--out", str(tmp_path / "none" / "r.html")]) == 2


def test_the_verdict_names_what_got_worse_for_everybody_beside_what_got_better(tmp_path: Path) -> None:
    """The mission gains, everybody is a second later; a run from before these figures has no such table."""
    late = [10.0 + 0.1 * k for k in range(10)]
    egoists = {"mission_success": [False] * 10, "total_delay_s": late}
    folder = write(
        tmp_path / "run",
        cell("idm", 10, columns=egoists),
        cell("altruist-rule", 10, columns={"total_delay_s": [x + 1.0 + 0.01 * x for x in late]}),
    )
    text = Page(report.write(read(folder)).read_text()).text
    better, worse, alike = (text.index(word) for word in ("better: ", "worse: ", "no difference shown: "))
    assert "mission success +100.0 pp" in text[better:worse]
    assert "everybody's delay +1.1" in text[worse:alike].replace("’", "'")
    assert "collisions" in text[alike:]
    assert "everybody's delay" not in text[alike : text.index("Figures", alike)]
    assert "Everybody on equal seeds" in text
    before = write(tmp_path / "before", cell("idm", 10), cell("rash", 10))
    assert "Everybody" not in Page(report.write(read(before)).read_text()).text


def test_options_of_a_users_file_that_were_changed_are_named(tmp_path: Path) -> None:
    folder = write(tmp_path / "run", cell("idm", 2))
    file = folder / "manifest.json"
    document = json.loads(file.read_text())
    changed = {"step-length": {"file": "1", "used": "0.1", "why": "AVs are commanded"}}
    for about in document["cells"].values():
        about["manifest"] = {"traffic": "controlled", "changed_options": changed}
    file.write_text(json.dumps(document))
    assert "merge: controlled: step-length 1 -> 0.1" in Page(report.html(read(folder))).text
