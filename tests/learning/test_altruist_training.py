"""`cosim train altruist`: a search in small, interrupted and resumed, and a drive with what it found."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cosim.cli.main import main
from cosim.learning import train_altruist
from cosim.policies import make
from cosim.scenario.options import EpisodeOptions
from cosim.types import Floats
from policy.agents.altruist import Altruist
from policy.agents.yield_rule import HABITS, Habits
from policy.training import search

CASE = EpisodeOptions("merge", policy="yield-rule", demand=("contested",), duration=4.0, penetration=0.5)


def brief(_seed: int, generations: int, _folder: Path) -> Iterator[list[EpisodeOptions]]:
    """Four seconds of a merge each."""
    yield from ([CASE.with_seed(number)] for number in range(generations))


def costs(_cases: object, candidates: list[Habits], _workers: int) -> Floats:
    """Without a drive: the first habit has a cost."""
    return np.array([[candidate.behind for candidate in candidates]])


def test_a_search_goes_on_after_an_interruption_as_if_there_had_been_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train_altruist, "roads", brief)
    monkeypatch.setattr(train_altruist, "_driven", costs)

    def train(name: str, generations: int, *more: str) -> int:
        words = ["train", "altruist", "--out", str(tmp_path / name), "--workers", "2"]
        return main([*words, "--iterations", str(generations), *more])

    assert train("whole", 2) == 0
    assert train("parts", 1) == 0
    assert train("parts", 2) == 2
    assert "holds a training run already" in capsys.readouterr().err
    assert train("parts", 2, "--resume", "--seed", "1") == 2
    assert "has another seed" in capsys.readouterr().err
    assert train("parts", 2, "--resume") == 0

    logs = [(tmp_path / name / "log.jsonl").read_text().splitlines() for name in ("whole", "parts")]
    assert logs[0] == logs[1]
    found = make(str(tmp_path / "parts"))
    assert isinstance(found, Altruist)
    assert found.name == "parts"
    assert found.habits.behind < HABITS.behind


def test_candidates_drive_and_what_was_found_is_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train_altruist, "roads", brief)
    monkeypatch.setattr(search, "POPULATION", 3)
    run = str(tmp_path / "run")
    assert main(["train", "altruist", "--out", run, "--iterations", "1"]) == 0
    line = json.loads((tmp_path / "run" / "log.jsonl").read_text())
    assert len(line["ranks"]) == len(line["costs"][0]) == 3
    capsys.readouterr()
    assert main(["run", "merge", "--policy", run, "--duration", "4", "--seed", "150000", "--json"]) == 0
    assert "run" in json.loads(capsys.readouterr().out)["policy"]


@pytest.mark.parametrize(
    ("what", "flag", "value"),
    [
        ("altruist", "reward", "p"),
        ("altruist", "config", "smoke"),
        ("altruist", "device", "cuda"),
        ("encoder", "variant", "hpn-plain"),
        ("hpn", "metric", "collisions"),
        ("vfn", "variant", "hpn-plain"),
    ],
)
def test_flags_of_other_trainings_are_refused(
    what: str, flag: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", what, f"--{flag}", value, "--out", str(tmp_path / "run")]) == 2
    assert f"does not apply to {what}" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
