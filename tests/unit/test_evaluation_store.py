"""What is kept of a run: each episode once and whole, NA as null; folders left as they were found."""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.csv
import pyarrow.parquet
import pytest

from cosim.batch import execution as batch
from cosim.batch import matrix
from cosim.batch.export import arrow, export
from cosim.batch.folder import RunFolder
from cosim.batch.record import planned
from cosim.batch.records import row
from cosim.batch.store import Store
from cosim.errors import BadInput, CosimError
from cosim.scenario.options import EpisodeOptions
from cosim.workers.tasks import Outcome, Task


@pytest.fixture(scope="module")
def plan() -> matrix.Plan:
    """Two cells of three seeds."""
    return planned(range(7, 10), scenario="merge", policy=["random", "idm"])


def document(case: EpisodeOptions, cell: matrix.Cell) -> dict[str, Any]:
    """As `cosim run --json` has it, of an episode that was never driven."""
    return {
        "scenario": "merge",
        "policy": case.policy,
        "policy_label": "untrained",
        "seed": case.seed,
        "crashed": case.seed == 8,
        "mission_time_s": None,
        "dt_mean_m": 100.0 / 3.0 + case.seed,
        "trace_hash": "ab" * 32,
        "timings": {"reset_s": 0.5, "total_s": 1.5},
        "collision_list": [{"time": 1.0}],
        "not_comparable_because": [],
        "units": {"dt_mean_m": "m"},
        "better": {"dt_mean_m": "higher"},
        "manifest": {**cell.manifest, "seed": case.seed, "weights": "ff"},
    }


class Pretender:
    """An engine that drives nothing: every episode comes through, but for those in `fates`."""

    def __init__(self, plan: matrix.Plan, **fates: Outcome) -> None:
        self._cells = {cell.name: cell for cell in plan.cells}
        self._fates = fates
        self.driven: list[str] = []

    def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        for task in reversed(tasks):  # they come in as they like
            self.driven.append(task.key)
            case = task.arguments[0]
            fate = self._fates.get(f"{case.policy}_{case.seed}")
            if fate is not None:
                yield replace(fate, key=task.key)
            else:
                yield Outcome(task.key, "ok", document(case, self._cells[task.group]))


def nothing(done: float, total: float) -> None:
    """Ignores the progress."""


def test_rows_come_back_in_the_matrix_s_order_whatever_order_they_came_in(
    plan: matrix.Plan, tmp_path: Path
) -> None:
    with Store.in_folder(tmp_path) as store:
        batch.begin(plan, store, {"command": "cosim evaluate"})
        lost = Outcome("", "sim_crash", error="it died", stderr="Error: why", attempts=2)
        batch.drive(plan, store, Pretender(plan, idm_9=lost), tmp_path, nothing)
        rows = store.rows()
        assert [(r["policy"], r["seed"]) for r in rows] == [
            (p, s) for p in ("random", "idm") for s in (7, 8, 9)
        ]
        assert [r["key"] for r in rows] == [case.key for _, case in plan.cases()]
        assert rows[1]["dt_mean_m"] == 100.0 / 3.0 + 8, "to the last bit"
        assert (rows[5]["status"], rows[5]["error"], rows[5]["attempts"]) == ("sim_crash", "it died", 2)
        assert store.document()["units"] == {"dt_mean_m": "m"}
        cell = plan.cells[0]
        assert store.cells()[cell.name]["manifest"] == {**cell.manifest, "weights": "ff"}, (
            "as the worker saw it"
        )


def test_a_resumed_run_drives_what_is_missing_and_nothing_twice(plan: matrix.Plan, tmp_path: Path) -> None:
    with Store.in_folder(tmp_path) as store:
        batch.begin(plan, store, {})
        fault = Outcome("", "fault", error="a bug of ours", stderr="Traceback")
        faults = batch.drive(plan, store, Pretender(plan, idm_8=fault), tmp_path, nothing)
        assert [f.key for f in faults] == [plan.cells[1].case.with_seed(8).key]
        assert len(store.rows()) == 5, "our own fault says nothing of the episode"
    with Store.in_folder(tmp_path) as store:
        batch.check_same(plan, store)
        engine = Pretender(plan)
        assert batch.drive(plan, store, engine, tmp_path, nothing) == []
        assert engine.driven == [plan.cells[1].case.with_seed(8).key]
        assert len(store.rows()) == 6
        with pytest.raises(CosimError, match="stored already"):
            store.add(store.rows()[:1])


def test_a_net_that_was_refused_has_its_rows_without_being_driven(plan: matrix.Plan, tmp_path: Path) -> None:
    refused = replace(plan, cells=(plan.cells[0], replace(plan.cells[1], refused="no version")))
    engine = Pretender(plan)
    with Store.in_folder(tmp_path) as store:
        batch.begin(refused, store, {})
        batch.drive(refused, store, engine, tmp_path, nothing)
        assert len(engine.driven) == 3
        assert [r["status"] for r in store.rows()] == ["ok"] * 3 + ["bad_input"] * 3
        assert store.rows()[5]["error"] == "no version"


def test_another_spec_or_another_version_of_a_file_is_refused_on_resume(
    plan: matrix.Plan, tmp_path: Path
) -> None:
    with Store.in_folder(tmp_path) as store:
        batch.begin(plan, store, {})
        with pytest.raises(BadInput, match="run of another spec"):
            batch.check_same(replace(plan, seeds=range(7, 11)), store)
        files = {**plan.cells[0].manifest["files"], "merge.sumocfg": "00"}
        cell = replace(plan.cells[0], manifest={**plan.cells[0].manifest, "files": files})
        with pytest.raises(BadInput, match=r"files\.merge\.sumocfg: has changed since the run began"):
            batch.check_same(replace(plan, cells=(cell, plan.cells[1])), store)


def test_a_worker_that_sees_other_versions_than_the_planner_stops_the_run(
    plan: matrix.Plan, tmp_path: Path
) -> None:
    class Elsewhere(Pretender):
        def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
            for outcome in super().run(tasks):
                outcome.value["manifest"]["versions"] = {"libsumo": "1.0"}
                yield outcome

    with Store.in_folder(tmp_path) as store:
        batch.begin(plan, store, {})
        with pytest.raises(BadInput, match=r"versions\..*has changed in a worker"):
            batch.drive(plan, store, Elsewhere(plan), tmp_path, nothing)
        assert store.rows() == []


def test_two_runs_share_a_database_and_each_sees_its_own(plan: matrix.Plan, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'all.sqlite'}"
    with Store(url, "monday") as monday, Store(url, "tuesday") as tuesday:
        batch.begin(plan, monday, {})
        batch.drive(plan, monday, Pretender(plan), tmp_path, nothing)
        assert (tuesday.spec_hash(), tuesday.rows(), tuesday.keys()) == (None, [], set())
        batch.begin(plan, tuesday, {})
        batch.drive(plan, tuesday, Pretender(plan), tmp_path, nothing)
        assert monday.rows() == tuesday.rows() != []


def test_a_store_that_cannot_be_is_one_sentence_without_the_password(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadInput, match="is no database URL"):
        Store("nonsense")
    with pytest.raises(BadInput, match="unable to open database file"):
        Store("sqlite:////not/there/at/all.sqlite")
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(BadInput, match=r"pip install 'cosim-sumo\[postgresql\]'") as caught:
        Store("postgresql+psycopg://me:secret@host/db")
    assert "secret" not in str(caught.value)


def test_a_database_that_fills_up_ends_the_run_with_one_sentence(plan: matrix.Plan, tmp_path: Path) -> None:
    with Store.in_folder(tmp_path) as store:
        batch.begin(plan, store, {})
        with store._engine.connect() as connection:
            pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()
            connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")
        long = Outcome("", "sim_crash", stderr="x" * 100_000)
        with pytest.raises(CosimError, match=r"cannot write: database or disk is full \(--resume continues"):
            batch.drive(plan, store, Pretender(plan, idm_8=long), tmp_path, nothing)
        assert [(r["policy"], r["seed"]) for r in store.rows()] == [("idm", 9)], "what came before is kept"


def test_exports_say_null_where_there_is_no_figure_and_hold_every_digit(
    plan: matrix.Plan, tmp_path: Path
) -> None:
    cell = plan.cells[0]
    cases = [case for c, case in plan.cases() if c is cell]
    rows = [row(cell, case, Outcome(case.key, "ok", document(case, cell))) for case in cases[:2]]
    rows.append(row(cell, cases[2], Outcome(cases[2].key, "timeout", error="no heartbeat", attempts=1)))
    export(tmp_path, rows, {"cells": {}}, {"episodes": 3})
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "episodes.csv",
        "episodes.parquet",
        "manifest.json",
        "summary.json",
    ]
    table = pyarrow.parquet.read_table(tmp_path / "episodes.parquet")
    found = table.to_pylist()
    assert [r["crashed"] for r in found] == [False, True, None]
    assert [r["dt_mean_m"] for r in found] == [100.0 / 3.0 + 7, 100.0 / 3.0 + 8, None]
    assert [r["mission_time_s"] for r in found] == [None, None, None]
    assert [r["penetration"] for r in found] == [None, None, None]
    assert [r["reset_s"] for r in found] == [0.5, 0.5, None]
    assert json.loads(found[0]["timings"]) == {"reset_s": 0.5, "total_s": 1.5}
    assert json.loads(found[0]["collision_list"]) == [{"time": 1.0}]
    assert found[2]["status"] == "timeout"
    assert table.column_names[:3] == ["key", "cell", "status"]
    text = pyarrow.csv.read_csv(tmp_path / "episodes.csv").to_pylist()
    assert [r["dt_mean_m"] for r in text] == [r["dt_mean_m"] for r in found]


def test_a_column_of_whole_numbers_and_fractions_is_one_of_fractions() -> None:
    table = arrow([{"a": 1, "b": True, "c": 2}, {"a": 0.5, "b": None, "c": 3}])
    assert [str(table.schema.field(n).type) for n in "abc"] == ["double", "bool", "int64"]


def test_a_folder_in_use_or_with_results_is_refused_and_not_changed(tmp_path: Path) -> None:
    with RunFolder(str(tmp_path), resume=False, episodes=1):
        with pytest.raises(BadInput, match="another process is working in it"):
            RunFolder(str(tmp_path), resume=True, episodes=1)
        (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(BadInput, match=r"--out=.*holds summary\.json already: continue with --resume"):
        RunFolder(str(tmp_path), resume=False, episodes=1)
    assert [p.name for p in tmp_path.iterdir()] == ["summary.json"]


def test_a_folder_that_cannot_be_made_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BadInput, match="cannot make this folder: not a directory"):
        RunFolder(str(tmp_path / "file" / "run"), resume=False, episodes=1)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_disk_without_space_for_the_results_is_found_before_the_run(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, before[1]))  # a small quota
    try:
        with pytest.raises(BadInput, match=r"cannot hold the results \(32 MB at most\): file too large"):
            RunFolder(str(tmp_path / "deep" / "run"), resume=False, episodes=1000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
