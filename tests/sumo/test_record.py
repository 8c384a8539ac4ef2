"""`cosim record` as a user meets it: resumed after kill -9 it holds every episode once, and the same ones."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cosim.cli.main import main
from cosim.recording.file import read
from cosim.recording.folder import Folder
from cosim.recording.views import histories
from cosim.types import COMPACT

FLAGS = "record --scenario merge --demand free --behavior mixed --policy idm --policy keep-lane --duration 4"


def record(folder: Path, seeds: str, *more: str) -> int:
    return main([*FLAGS.split(), "--seeds", seeds, "--out", str(folder), *more])


def test_killed_and_resumed_it_holds_every_episode_once(tmp_path: Path) -> None:
    folder = Folder(tmp_path / "out")
    command = [
        sys.executable,
        "-m",
        "cosim.cli.main",
        *FLAGS.split(),
        "--seeds",
        "0:3",
        "--out",
        str(folder.path),
    ]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    give_up = time.monotonic() + 120.0
    while not (folder.path / "episodes").is_dir() or not folder.episodes():
        assert time.monotonic() < give_up
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = {key: folder.episode_file(key).stat().st_mtime_ns for key in folder.episodes()}
    assert 1 <= len(before) < 6
    assert record(folder.path, "0:3", "--resume") == 0
    assert len(folder.episodes()) == 6
    after = {key: folder.episode_file(key).stat().st_mtime_ns for key in before}
    assert after == before, "what was there is not driven again"
    manifest = folder.manifest()
    assert sorted(manifest["episodes"]) == folder.episodes()
    assert manifest["seeds"] == [0, 1, 2]
    assert {cell["case"]["policy"] for cell in manifest["cells"].values()} == {"idm", "keep-lane"}
    assert all(len(cell["manifest"]["files"]) >= 3 for cell in manifest["cells"].values())
    assert not list(folder.path.rglob("*.part"))

    anew = Folder(tmp_path / "anew")
    assert record(anew.path, "1:2") == 0
    for key in anew.episodes():
        a, b = read(anew.episode_file(key)), read(folder.episode_file(key))
        assert a.case == b.case
        assert all(
            np.array_equal(a.table[c], b.table[c], equal_nan=a.table[c].dtype.kind == "f") for c in a.table
        )
    seen = [found for _, found in histories(a, anew.road(a), COMPACT)]
    assert len(seen) == 11
    assert any(h.velocity_map.any() for found in seen for h in found.values())


def test_a_recording_holds_the_errors_that_were_asked_for(tmp_path: Path) -> None:
    flags = ["record", "--scenario", "merge", "--demand", "contested", "--policy", "idm", "--duration", "8"]
    for errors in ("none", "stress"):
        out = tmp_path / errors
        assert main([*flags, "--errors", errors, "--seeds", "3:4", "--out", str(out)]) == 0
        (key,) = Folder(out).episodes()
        events = read(Folder(out).episode_file(key)).events
        begun = [error for happened in events.values() for error in happened.errors]
        assert bool(begun) == (errors == "stress")
        (cell,) = Folder(out).manifest()["cells"].values()
        assert cell["manifest"].get("errors", {}).get("name", "none") == errors


def test_it_never_writes_over_recordings_by_accident(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "manifest.json").write_text(json.dumps({"format": "cosim-recording-1"}))
    assert record(tmp_path, "0:1") == 2
    assert "--resume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        ("--policy idn --seeds 0:1", "idm"),
        ("--scenario merg --seeds 0:1", "merge"),
        ("--demand dens --seeds 0:1", "dense"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_driven(
    flags: str, word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", "--scenario", "exit", *flags.split(), "--out", str(tmp_path / "out")]) == 2
    assert word in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_bench_predict_records_what_it_needs_and_writes_its_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = "--scenario merge --demand free --behavior mixed --policy idm --seeds 200000:200002 --no-maps"
    out = tmp_path / "bench"
    assert main(["bench", "predict", *flags.split(), "--out", str(out)]) == 0
    assert "gp-indirect" in capsys.readouterr().out
    rows = (out / "position_error.csv").read_text().splitlines()
    assert len(rows) == 1 + 9 * 3 * 7, "predictors x (behaviour, scenario, all) x horizons and their mean"
    assert (out / "interval_coverage.csv").is_file()
    assert (out / "position_error.png").is_file()
    assert len(Folder(out / "recordings").episodes()) == 2
    again = ["bench", "predict", "--recordings", str(out / "recordings"), "--seeds", "7:9", "--out", str(out)]
    assert main([*again, "--no-maps"]) == 2
    assert "holds no recording of these" in capsys.readouterr().err
