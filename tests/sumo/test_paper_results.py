"""The papers' tables and figures, each rebuilt in small: untrained networks, one world, a second each."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.papers import (
    conditions,
    decisions,
    driving,
    episodes,
    figure9,
    learning,
    phi,
    shipped,
    summary,
    t_figure8,
    t_figures,
    table3,
)
from benchmarks.papers.agents import Agent, missing
from benchmarks.papers.claims import VFN_P
from benchmarks.papers.driving import Order, Settings, drive
from benchmarks.papers.pages import Job, run_jobs
from cosim.errors import BadInput

JOBS = (table3.JOB, decisions.JOB, figure9.JOB, t_figures.JOB, t_figure8.JOB, phi.JOB, conditions.JOB)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Settings of a tiny run whose episodes have all been driven, in one worker process."""
    folder = tmp_path_factory.mktemp("papers")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)  # away from whatever was trained in this checkout's runs/
        patch.setattr(driving, "LEAST", 1)
        patch.setattr(figure9, "BEHAVIORS", ("mixed",))
        patch.setattr(phi, "PHIS", (0.0, 45.0))
        patch.setattr(conditions, "RANGES", (125.0,))
        patch.setattr(conditions, "SENSED", conditions.SENSED[:1])
        patch.setattr(conditions, "DRIVEN_BY", ("aggressive",))
        settings = Settings(
            runs=folder / "runs",
            out=folder / "pages",
            scale=1e-6,
            scenarios=("merge",),
            workers=1,
            untrained=True,
            duration=1.2,
            trainings={VFN_P: (_training(folder / VFN_P),)},
        )
        drive([order for job in JOBS for order in job.orders()], settings, "small")
        run_jobs(JOBS, settings)
        learning.write(settings)
        summary.write(settings)
        yield settings


def _training(run: Path) -> Path:
    """Forty iterations in the trainer's format, crashes falling from all to none."""
    run.mkdir()
    lines = [
        {"iteration": k, "train/crashed": float(k < 20), "train/mission_success": 1.0, "train/dt_mean_m": 9.0}
        for k in range(40)
    ]
    (run / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return run


def page(settings: Settings, name: str) -> str:
    return (settings.out / f"{name}.md").read_text()


def lines(settings: Settings, name: str) -> list[dict[str, str]]:
    with (settings.out / "data" / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.name)
def test_every_page_is_rebuilt_and_says_that_its_networks_are_untrained(small: Settings, job: Job) -> None:
    text = page(small, job.name)
    assert text.startswith(f"# {job.title}\n\nMade by `{job.command} --scale 1e-06")
    assert "**Untrained networks" in text
    assert "(untrained value network)" in text
    learned = [line for line in lines(small, job.name) if line["arm"].startswith(("vfn", "conv", "safe"))]
    assert learned
    assert all("untrained" in line["arm"] for line in learned)
    for picture in [part.split(")")[0] for part in text.split("](")[1:]]:
        if picture.endswith((".svg", ".png")):
            assert (small.out / picture).stat().st_size > 1000


def test_table_3_holds_every_approach_beside_the_unguarded_fleet(small: Settings) -> None:
    rates = [x for x in lines(small, "table3") if x["figure"] == "collision_rate" and not x["against"]]
    arms = [x["arm"].split(" (")[0] for x in rates]
    assert arms == list(dict.fromkeys(arms))
    assert {*table3.APPROACHES, "keep-lane", "idm", "maps, no mask", "no maps, mask gp"} <= set(arms)
    assert {x["n"] for x in rates} == {"1"}
    assert "not below P's 1.04" in page(small, "table3")  # one episode shows nothing


def test_the_curves_of_learning_are_drawn_from_the_logs(small: Settings) -> None:
    text = page(small, "learning")
    assert f"| {VFN_P} | ? | 40 | training drives | crashed, % | 100.0 | 0.0 |" in text
    assert (small.out / "learning.png").stat().st_size > 1000
    assert len(lines(small, "learning")) == 3 * 21  # figures x points


def test_a_second_run_drives_nothing_and_writes_the_same(small: Settings, capfd: Any) -> None:
    before = {p: p.read_bytes() for p in small.out.rglob("*") if p.is_file()}
    capfd.readouterr()
    run_jobs([table3.JOB, phi.JOB], replace(small, workers=1))
    summary.write(small)
    assert "SUMO" not in capfd.readouterr().err
    assert {p: p.read_bytes() for p in small.out.rglob("*") if p.is_file()} == before


def test_more_episodes_drive_only_those_that_are_missing(small: Settings) -> None:
    order = Order(Agent("keep-lane"), "merge", "dense", "mixed", 3)
    missed: list[str] = []

    def begin(plan: Any, store: Any, *_: Any) -> list[Any]:
        known = store.keys()
        missed.extend(case.key for _, case in plan.cases() if case.key not in known)
        return []  # nothing is driven

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driving.batch, "drive", begin)
        found = drive([order], replace(small, scale=1.0), "more")
    assert [row["seed"] for row in found.driven[0].rows] == [200_000]
    assert [key.rpartition("-")[2] for key in missed] == ["200001", "200002"]


def test_a_dry_run_counts_what_is_missing_once_and_writes_nothing(
    small: Settings, tmp_path: Path, capfd: Any
) -> None:
    order = Order(Agent("keep-lane"), "merge", "dense", "mixed", 3)
    jobs = [Job(name, name, lambda: [order], lambda *_: None) for name in ("one", "two")]
    out = tmp_path / "pages"
    run_jobs(jobs, replace(small, scale=1.0, out=out), dry_run=True)
    said = capfd.readouterr()
    assert said.err == "one: measuring what 1 agents cost ...\n"
    lines = said.out.splitlines()
    assert [line.partition(" episodes")[0] for line in lines] == [
        "one: keep-lane: 2",
        "one: 2",
        "two: 0",
        "all: 2",
    ]
    assert float(lines[0].split()[-3]) >= 0.0
    assert not out.exists()


def test_shipped_episodes_are_taken_instead_of_driven_and_make_the_same_pages(
    small: Settings, tmp_path: Path, capfd: Any
) -> None:
    jobs = (table3.JOB, phi.JOB)
    kept = episodes.keep(replace(small, shipped=tmp_path / "episodes"), jobs)
    elsewhere = replace(small, runs=tmp_path / "runs", out=tmp_path / "pages", shipped=tmp_path / "episodes")
    capfd.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driving, "LocalEngine", _NoEngine)
        run_jobs(jobs, elsewhere)
    assert "episodes taken from" in capfd.readouterr().err
    assert kept.total() == len({row["key"] for row in shipped.episodes(elsewhere.shipped).rows})
    for job in jobs:
        for name in (f"{job.name}.md", f"data/{job.name}.csv", f"{job.name}.svg"):
            assert (elsewhere.out / name).read_bytes() == (small.out / name).read_bytes()


def test_with_held_nothing_is_driven_and_a_page_that_would_lack_an_arm_is_left(
    small: Settings, tmp_path: Path, capfd: Any
) -> None:
    held = replace(small, held=True, scale=1.0, out=tmp_path / "pages")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driving, "LocalEngine", _NoEngine)
        run_jobs([table3.JOB, t_figure8.JOB], held)
        run_jobs([table3.JOB], replace(held, runs=tmp_path / "runs"))
    said = capfd.readouterr().err
    assert "t_figure8: left as it is: its episodes are driven once more" in said
    assert f"table3: left as it is: {len(table3.orders()) // 5} arms have no episode" in said
    text = page(held, "table3")
    assert "Of every arm as many episodes as were driven so far (n)" in text
    assert "python -m benchmarks.papers.table3 --scenario merge --duration 1.2 --held" in text
    rates = [x for x in lines(held, "table3") if x["figure"] == "collision_rate" and not x["against"]]
    assert {x["n"] for x in rates} == {"1"}


class _NoEngine:
    """Lets nothing be driven."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def run(self, tasks: Any) -> Any:
        assert not tasks
        yield from ()


def test_a_shipped_episode_that_is_not_the_same_again_is_found_and_named(
    small: Settings, tmp_path: Path
) -> None:
    order = Order(Agent("idm"), "merge", "dense", "mixed", 1)
    jobs = [Job("one", "One episode", lambda: [order], lambda *_: None)]
    mine = replace(small, shipped=tmp_path)
    with pytest.raises(BadInput, match="holds no shipped episodes"):
        episodes.check(mine, 1, jobs=jobs)
    episodes.keep(mine, jobs)
    assert episodes.check(mine, 5, jobs=jobs) == episodes.Checked(1, (), 1, 0)
    run = shipped.episodes(tmp_path)
    assert [cell["case"]["policy"] for cell in run.manifest["cells"].values()] == ["idm"]  # replay drives it
    shipped.write([{**run.rows[0], "collisions": 7}], run.manifest, tmp_path)
    (line,) = episodes.check(mine, 5, jobs=jobs).differing
    assert "idm in merge, dense, seed 200000: collisions is" in line
    assert line.endswith("shipped is 7")
    other = {**run.manifest, "versions": {"python": "2.7", "torch": "0.1+cpu"}}
    shipped.write([{**run.rows[0], "cell": "other"}], {**other, "cells": {"other": {}}}, tmp_path)
    with pytest.raises(BadInput, match=r"other versions \(torch 0\.1\) than are here"):
        episodes.check(mine, 1, jobs=jobs)
    with pytest.raises(BadInput, match=r"were driven with torch 0\.1: to keep others would drop them all"):
        episodes.keep(mine, jobs)


def test_what_was_driven_once_more_is_the_episode_that_was_counted(small: Settings) -> None:
    found = [json.loads(p.read_text()) for p in (small.runs / t_figure8.FOLDER).glob("*.json")]
    assert len(found) == len(t_figure8.AGENTS) * len(t_figure8.TRAFFIC)
    assert {one["seed"] for one in found} == {200_000}
    assert all(len(one["trace_hash"]) == 64 for one in found)


def test_the_course_of_training_is_drawn_where_there_is_a_log_and_missed_where_there_is_none(
    small: Settings,
) -> None:
    text = page(small, "t_figures")
    assert "t_figure7.png" in text
    assert f"- {VFN_P}: not run yet" not in text
    assert "- conv3d-a2c: not run yet (`cosim train conv3d-a2c" in text


def test_the_summary_says_untrained_and_not_run_yet(small: Settings, tmp_path: Path) -> None:
    text = page(small, "README")
    first = next(line for line in text.splitlines() if "VFN + P crashes in" in line)
    assert "merge 0.00 %" in first or "merge 100.00 %" in first
    assert "**untrained**" in first
    assert "highway not run yet" in first
    empty = replace(small, out=tmp_path)
    summary.write(empty)
    rows = [x for x in (tmp_path / "README.md").read_text().splitlines() if x.startswith(("| P", "| T"))]
    assert len(rows) == len(summary.CLAIMS)
    assert all(f"| {summary.NOT_RUN} |" in row for row in rows)


def test_missing_weights_are_said_in_one_line_with_the_command_that_makes_them(
    tmp_path: Path, capfd: Any
) -> None:
    agent = figure9.agent(VFN_P, "aggressive")
    why = missing(replace(agent, weights=str(tmp_path / "none.safetensors")))
    assert why is not None
    assert "none.safetensors" in why
    assert f"cosim train vfn --policy {VFN_P} --config" in why
    settings = Settings(runs=tmp_path / "runs", out=tmp_path, scenarios=("merge",), scale=1e-6)
    absent = Order(replace(agent, weights="nowhere.safetensors"), "merge", "dense", "mixed", 1)
    found = drive([absent], settings, "figure9")
    assert found.driven[0].rows == []
    assert found.absent == [f"{agent.name}: {missing(absent.agent)}"]
    assert capfd.readouterr().err.count("\n") == 1
