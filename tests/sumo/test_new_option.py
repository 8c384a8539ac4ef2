"""A new option of an episode is one field in one file: everything else that names options is derived."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import cosim

FIELD = '    top_speed: Positive | None = option(None, "m/s that no AV exceeds", metavar="MPS")\n'
BEFORE = "    reward: str | None = option(\n"
Python = Callable[..., str]

PYTHON = """
import inspect
import gymnasium
import cosim
from cosim.batch import matrix, spec
from cosim.service.requests import RunRequest, SessionRequest, flags

for model in (RunRequest, SessionRequest):
    print(model.model_json_schema()["properties"]["top_speed"]["description"])
given, _ = flags(RunRequest(scenario="merge", top_speed=9), None)
(case,) = matrix.cells(spec.read(None, given))
print(case.top_speed, case.document()["top_speed"])
print(inspect.signature(cosim.open).parameters["top_speed"].default)
words = {"demand": "contested", "duration": 1, "top_speed": 9, "worker": False}
with cosim.open("merge", **words) as session:
    session.reset()
    print(session.scenario.asked.top_speed, session.result().document()["top_speed"])
env = gymnasium.make("cosim/Merge-v0", **words)
print(env.unwrapped.session.scenario.asked.top_speed)
env.close()
try:
    cosim.open("merge", top_speed=-1)
except Exception as error:
    print(error)
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Python:
    """Runs Python where `EpisodeOptions` has one more field, and all other files are as they are."""
    root, package = tmp_path_factory.mktemp("more"), Path(cosim.__file__).parent
    for folder in (package, package / "scenario"):
        here = root / folder.relative_to(package.parent)
        here.mkdir()
        for entry in folder.iterdir():
            if entry.name not in ("scenario", "options.py", "__pycache__"):
                (here / entry.name).symlink_to(entry)
    text = (package / "scenario" / "options.py").read_text()
    assert text.count(BEFORE) == 1
    (root / "cosim" / "scenario" / "options.py").write_text(text.replace(BEFORE, FIELD + BEFORE))

    def run(*words: str, cwd: Path = root) -> str:
        known = os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{package.parent}"}
        done = subprocess.run([sys.executable, *words], cwd=cwd, env=known, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.mark.parametrize("command", ["run", "evaluate", "estimate", "record", "join"])
def test_every_command_that_drives_has_the_flag(python: Python, command: str) -> None:
    said = python("-m", "cosim.cli.main", command, "--help")
    assert "--top-speed MPS" in said
    assert "m/s that no AV exceeds" in said


def test_spec_yaml_has_the_field_and_the_row_its_column(python: Python, tmp_path: Path) -> None:
    (tmp_path / "SPEC.yaml").write_text("scenario: merge\nduration: 1\ntop_speed: 9\n")
    words = ["evaluate", "SPEC.yaml", "--out", "run", "--workers", "1", "--no-report"]
    python("-m", "cosim.cli.main", *words, cwd=tmp_path)
    (row,) = csv.DictReader((tmp_path / "run" / "episodes.csv").read_text().splitlines())
    assert (row["status"], float(row["top_speed"])) == ("ok", 9.0)


def test_http_sessions_and_environments_take_it(python: Python) -> None:
    assert python("-c", PYTHON).splitlines() == [
        "m/s that no AV exceeds",
        "m/s that no AV exceeds",
        "9.0 9.0",
        "None",
        "9.0 9.0",
        "9.0",
        "top_speed=-1: must be more than 0",
    ]
