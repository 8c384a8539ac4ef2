"""`cosim evaluate` as a user meets it: one matrix, every episode once, whatever is killed or wrong."""

from __future__ import annotations

import csv
import json
import operator
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest

from cosim.cli.main import main
from cosim.types import TIMINGS

MATRIX = "--scenario merge --demand free --policy idm --policy keep-lane --duration 4 --seeds 200000:200003"
TIMES = {"timings", "attempts", *TIMINGS}


def evaluate(flags: str, *more: object, expect: int = 0) -> None:
    """The command, in this process: the simulations are in others."""
    assert main(["evaluate", *flags.split(), *map(str, more)]) == expect


def rows(folder: Path) -> list[dict[str, Any]]:
    """What a run left, less what differs from run to run."""
    table = pyarrow.parquet.read_table(folder / "episodes.parquet").to_pylist()
    return [{k: v for k, v in row.items() if k not in TIMES} for row in table]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `MATRIX` with one worker."""
    folder = tmp_path_factory.mktemp("runs") / "undisturbed"
    evaluate(MATRIX, "--workers", 1, "--out", folder)
    return folder


def test_the_run_folder_holds_every_episode_in_every_form(undisturbed: Path) -> None:
    found = rows(undisturbed)
    assert [(r["policy"], r["seed"]) for r in found] == [
        (policy, seed) for policy in ("idm", "keep-lane") for seed in (200000, 200001, 200002)
    ]
    assert {r["status"] for r in found} == {"ok"}
    assert {r["steps"] for r in found} == {10}
    with (undisturbed / "episodes.csv").open() as file:
        assert [r["trace_hash"] for r in csv.DictReader(file)] == [r["trace_hash"] for r in found]
    manifest = json.loads((undisturbed / "manifest.json").read_text())
    assert manifest["seeds"] == [200000, 200003]
    assert manifest["units"]["dt_mean_m"] == "m"
    assert {r["cell"] for r in found} == set(manifest["cells"])
    for cell in manifest["cells"].values():
        assert cell["manifest"]["versions"]["libsumo"] == "1.28.0"
        assert "merge.sumocfg" in cell["manifest"]["files"]
    summary = json.loads((undisturbed / "summary.json").read_text())
    assert (summary["episodes"], summary["status"]["ok"]) == (6, 6)
    assert "keep-lane" in (undisturbed / "report.html").read_text()


def test_an_episode_is_the_one_that_cosim_run_drives(
    undisturbed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = "--demand free --policy keep-lane --duration 4 --seed 200002 --json"
    main(["run", "merge", *flags.split()])
    document = json.loads(capsys.readouterr().out)
    row = rows(undisturbed)[5]
    assert row["trace_hash"] == document["trace_hash"]
    same = [k for k in document if k in row and not isinstance(document[k], list | dict)]
    assert len(same) > 30
    assert [row[k] for k in same] == [document[k] for k in same]
    missing = {"timings", "units", "better", "manifest"}
    assert document.keys() - row.keys() == missing, "the columns are those of cosim run --json"


def test_json_is_exactly_one_document(undisturbed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate("--resume --json --no-report", "--out", undisturbed)
    assert json.loads(capsys.readouterr().out) == json.loads((undisturbed / "summary.json").read_text())


def test_workers_and_parent_killed_and_resumed_every_episode_once_and_the_same(
    undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    command = [sys.executable, "-m", "cosim.cli.main", "evaluate", *MATRIX.split(), "--workers", "2"]
    parent = subprocess.Popen([*command, "--out", str(out)], stderr=subprocess.PIPE)
    wait_for_rows(out, 1, parent)
    os.kill(workers_of(parent.pid)[0], signal.SIGKILL)
    wait_for_rows(out, 2, parent)
    end = time.monotonic() + 30.0
    while len(workers := workers_of(parent.pid)) < 2 and time.monotonic() < end:
        time.sleep(0.01)  # the one that was killed comes back
    parent.kill()
    parent.communicate()
    assert len(workers) == 2
    end = time.monotonic() + 5.0
    while any(Path(f"/proc/{pid}").exists() for pid in workers):
        assert time.monotonic() < end, "workers outlived their parent"
        time.sleep(0.05)
    spec = tmp_path / "SPEC.yaml"  # the same matrix as the flags
    spec.write_text(
        "scenario: merge\ndemand: free\npolicy: [keep-lane, idm]\nduration: 4\nseeds: '200000:200003'\n"
    )
    evaluate("--resume --workers 2 --no-report", spec, "--out", out)
    key = operator.itemgetter("key")
    assert sorted(rows(out), key=key) == sorted(rows(undisturbed), key=key)


def wait_for_rows(out: Path, count: int, parent: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + 120.0
    while time.monotonic() < end and parent.poll() is None:
        if kept(out / "store.sqlite") >= count:
            return
        time.sleep(0.02)
    raise AssertionError(f"no {count} rows: {parent.poll()}")


def kept(store: Path) -> int:
    """Rows in the store of a run that is going on."""
    try:
        with closing(sqlite3.connect(f"file:{store}?mode=ro", uri=True)) as connection:
            return int(connection.execute("SELECT count(*) FROM cosim_episodes").fetchone()[0])
    except sqlite3.OperationalError:  # not there yet
        return 0


def workers_of(pid: int) -> list[int]:
    """The worker processes (the threads' children; multiprocessing's own helper is no worker)."""
    found = []
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        found += [int(word) for word in file.read_text().split()]
    return [
        child for child in found if b"resource_tracker" not in Path(f"/proc/{child}/cmdline").read_bytes()
    ]


@pytest.mark.soak
def test_a_ray_node_killed_in_mid_run_loses_nothing(undisturbed: Path) -> None:
    pytest.importorskip("ray")
    script = Path(__file__).parent / "ray_two_nodes.py"
    done = subprocess.run(
        [sys.executable, str(script), *MATRIX.split()],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        check=True,
        timeout=300,
    )
    found = json.loads(done.stdout.splitlines()[-1])
    assert found == {row["key"]: row["trace_hash"] for row in rows(undisturbed)}


def test_a_net_that_kills_sumo_costs_its_own_rows_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.net.xml").write_text("<net></net>")
    config = tmp_path / "bad.sumocfg"
    config.write_text('<configuration><net-file value="bad.net.xml"/><end value="9"/></configuration>')
    flags = "--duration 2 --seeds 200000:200002 --workers 1 --no-report"
    evaluate(flags, "--scenario", config, "--scenario", "merge", "--out", tmp_path / "run")
    assert "2 of 4 episodes have no figures" in capsys.readouterr().err
    found = rows(tmp_path / "run")
    bad = f"{tmp_path.name}/bad"
    assert [(r["scenario"], r["status"]) for r in found] == [(bad, "bad_input")] * 2 + [("merge", "ok")] * 2
    assert "version" in found[0]["error"]
    assert found[0]["crashed"] is None, "NA is not 0"


def test_what_sumo_refuses_in_mid_run_costs_its_own_rows_and_the_next_cell_is_fine(tmp_path: Path) -> None:
    good = '<vehicle id="a" type="av" depart="0"><route edges="main_in main_acc main_out"/></vehicle>'
    bad = '<vehicle id="b" type="av" depart="41"><route edges="main_out main_in"/></vehicle>'  # no way back
    for name, vehicles in (("good", good), ("bad", good + bad)):
        text = f'<routes><vType id="av"/>{vehicles}</routes>'
        (tmp_path / f"{name}.rou.xml").write_text(text)
    flags = "--scenario merge --duration 4 --seeds 200000:200001 --workers 1 --no-report"
    evaluate(flags, "--demand", tmp_path / "*.rou.xml", "--out", tmp_path / "run")
    found = {r["demand"]: r for r in rows(tmp_path / "run")}
    assert found["good"]["status"] == "ok"
    assert found["bad"]["status"] == "bad_input", "the demand is to blame, not the simulator"
    assert "no valid route" in found["bad"]["error"] or "main_out" in found["bad"]["error"]


def test_demand_from_sumo_s_own_tools_runs_as_it_comes(tmp_path: Path) -> None:
    import sumo

    home = Path(sumo.__file__).parent
    game = home / "tools" / "game"
    for flags in (["-o", "a.trips.xml", "--seed", "1"], ["-o", "x.xml", "-r", "b.rou.xml", "--seed", "2"]):
        tool = [sys.executable, str(home / "tools" / "randomTrips.py")]
        net = str(game / "A10KW" / "osm.net.xml")
        subprocess.run(
            [*tool, "-n", net, "-e", "8", "-p", "0.5", *flags],
            cwd=tmp_path,
            env={**os.environ, "SUMO_HOME": str(home)},
            check=True,
            capture_output=True,
        )
    demands = ["--demand", tmp_path / "*.trips.xml", "--demand", tmp_path / "b*"]
    flags = "--penetration 0.5 --duration 8 --seeds 200000:200001 --workers 1 --no-report"
    evaluate(flags, "--scenario", game / "A10KW.sumocfg", *demands, "--out", tmp_path / "run")
    found = {r["demand"]: r for r in rows(tmp_path / "run")}
    assert sorted(found) == ["a.trips", "b"]
    for row in found.values():
        assert row["status"] == "ok", row["error"]
        assert row["vehicles_inserted"] > 5


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ("--policy idm", "scenario: name at least one"),
        ("--scenario merge --policy vpn", "unknown policy"),
        ("--scenario merge --seeds 9:9", "--seeds='9:9': no seed lies between"),
        ("--scenario merge --demand no/*.rou.xml", "no file matches"),
        ("--scenario merge --out {busy}", "holds summary.json already"),
        ("--scenario merge --out {file}/run", "cannot make this folder"),
        ("--scenario merge --resume --ray-address x", "goes with --engine ray"),
        ("--scenario merge --store nonsense", "is no database URL"),
        ("--scenario merge -- --scale 2", "else they belong into the .sumocfg"),
        ("--resume", "holds no run to resume"),
    ],
)
def test_what_is_wrong_is_said_before_anything_runs_and_nothing_is_left(
    flags: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "busy").mkdir()
    (tmp_path / "busy" / "summary.json").touch()
    given = flags.format(busy=tmp_path / "busy", file=tmp_path / "file").split()
    if "--out" not in given:
        given = ["--out", str(tmp_path / "deep" / "run"), *given]
    evaluate("", *given, expect=2)
    said = capsys.readouterr()
    assert sentence in said.err
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["busy", "file", "summary.json"]


def test_a_dry_run_prints_the_matrix_and_a_time_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    evaluate(f"{MATRIX} --dry-run --json --out run --workers 1")
    found = json.loads(capsys.readouterr().out)
    assert found["episodes"] == 6
    assert [cell["case"]["policy"] for cell in found["cells"]] == ["idm", "keep-lane"]
    assert 0.1 < found["estimated_s"] < 600.0
    assert "2 of 2 cells driven for 4 s" in found["estimated_from"]
    assert list(tmp_path.iterdir()) == []
