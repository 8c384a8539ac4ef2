"""The gates under examples/ci do what they promise: one lets its candidate pass, the other stops it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from junitparser import Failure, JUnitXml

from cosim.report.run_folder import read

EXAMPLES = Path(__file__).parents[2] / "examples" / "ci"
GATES = {"altruist": 0, "reckless": 1}


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str, Path]]:
    """Both gates, side by side: exit code, what they said, their folder."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    out = {name: tmp_path_factory.mktemp("gate") / name for name in GATES}
    running = {
        name: subprocess.Popen(
            ["sh", str(EXAMPLES / name / "gate.sh"), str(out[name])],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for name in GATES
    }
    found = {}
    for name, process in running.items():
        said, _ = process.communicate(timeout=600)
        found[name] = (process.returncode, said, out[name])
    return found


@pytest.mark.parametrize(("name", "expected"), GATES.items())
def test_the_gate_gives_its_verdict(done: dict[str, tuple[int, str, Path]], name: str, expected: int) -> None:
    code, said, folder = done[name]
    assert code == expected, said
    assert {row["status"] for row in read(folder).rows} == {"ok"}
    suites = JUnitXml.fromfile(str(folder / "junit.xml"))
    assert suites.tests == (3 if expected == 0 else 2)
    failures = [case for suite in suites for case in suite if case.result]
    assert all(isinstance(case.result[0], Failure) for case in failures)
    assert bool(failures) == (expected == 1)
    assert ("passed: 3 of 3" if expected == 0 else "failed: ") in (folder / "compare.md").read_text()
    assert (folder / "report.html").stat().st_size > 20_000


def test_the_reckless_candidate_is_stopped_for_its_crashes(
    done: dict[str, tuple[int, str, Path]],
) -> None:
    summary = json.loads((done["reckless"][2] / "summary.json").read_text())
    crashes = {g["policy"]: g["rates"]["av_caused_collision_rate"]["hits"] for g in summary["groups"]}
    assert crashes["idm"] == 0
    assert crashes["keep-lane"] >= 2


def test_the_workflow_calls_the_script_that_is_tested_here() -> None:
    workflow = yaml.safe_load((EXAMPLES / "github-actions.yaml").read_text())
    commands = [step["run"] for step in workflow["jobs"]["gate"]["steps"] if "run" in step]
    script = next(command.split()[1] for command in commands if command.startswith("sh "))
    assert (EXAMPLES.parents[1] / script).is_file()
