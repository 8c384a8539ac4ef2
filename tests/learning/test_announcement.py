"""What a training says before it learns anything."""

from __future__ import annotations

from concurrent.futures import Future

import pytest

from cosim.learning.announcement import Announced, begin
from policy.training.curriculum import Drive, DriveResult, Lesson, VfnTraining
from tests.learning.test_vfn_training import trajectory


class Recorders:
    """Each drive ends at once, with ten decisions."""

    def submit(self, drive: Drive) -> Future[DriveResult]:
        future: Future[DriveResult] = Future()
        future.set_result(DriveResult([trajectory([1] * 10, [(0, 0, 0)] * 10)], {}))
        return future


def said(wanted: int, recorded: int = 0) -> list[str]:
    """The lines about three drives."""
    lines: list[str] = []
    actors = Announced(Recorders(), wanted, lines.append)
    actors.recorded = recorded
    for seed in range(3):
        actors.submit(Drive(Lesson("merge"), seed, 0.0, 1.0, "", "", record=True))
    return lines


def test_a_training_says_what_it_does_and_where_the_curves_are(capsys: pytest.CaptureFixture[str]) -> None:
    training = VfnTraining(lessons=(Lesson("merge"), Lesson("exit")), iterations=30, episodes=2)
    begin("vfn-p", training, training.prefill, "runs/mine")
    text = capsys.readouterr().err
    assert "30 iterations of 2 drives, 60 in all" in text
    assert "merge (contested), exit (contested)" in text
    assert "after 2,000 recorded decisions" in text
    assert "tensorboard --logdir runs/mine" in text
    assert max(map(len, text.splitlines())) <= 100


def test_the_first_drive_says_how_long_it_takes_until_the_network_learns() -> None:
    first, last = said(wanted=30)
    assert first.startswith("10 of 30 decisions recorded, learning begins in at most ")
    assert last == "30 of 30 decisions recorded, learning begins"


def test_a_training_that_learns_already_says_nothing() -> None:
    assert said(wanted=0) == []
    assert said(wanted=30, recorded=30) == []
