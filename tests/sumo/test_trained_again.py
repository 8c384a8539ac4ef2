"""A training is its command and its seed: the same once more, and the networks that ship from theirs."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import trained_again
from benchmarks.learning import TRAININGS
from cosim.cli.main import main


def test_two_trainings_from_one_seed_log_the_same_whoever_drives(tmp_path: Path) -> None:
    """Without a mask it crashes within seconds: many drives of learned weights in little time."""
    config = tmp_path / "short.yaml"
    config.write_text("base: smoke\ntraining: {prefill: 5}\n")
    logs = []
    for workers in ("1", "2"):
        words = ["--config", str(config), "--seed", "3", "--workers", workers]
        assert main(["train", "conv2d-dqn", *words, "--out", str(tmp_path / workers)]) == 0
        log = trained_again.log(tmp_path / workers)
        logs.append([{k: v for k, v in line.items() if not k.endswith("_s")} for line in log])
    assert logs[0] == logs[1]
    assert [line["updates"] for line in logs[0]] == [0, 3, 6, 9]
    assert {"loss/td", "train/reward", "valid/reward"} <= logs[0][-1].keys()


def test_a_field_that_differs_is_named() -> None:
    shipped = [{"iteration": 0, "train/reward": 0.6843, "iteration_s": 5.0}, {"iteration": 1, "loss/td": 0.5}]
    driven = [{"iteration": 0, "train/reward": 0.68426, "iteration_s": 9.0, "replay": 7}]
    assert [*trained_again.compared(shipped[:1], driven)] == []
    assert [*trained_again.compared(shipped, [{**driven[0], "train/reward": 0.6845}])] == [
        "iteration 0, train/reward: shipped 0.6843, now 0.6845",
        "iteration 1, iteration: shipped 1, now None",
        "iteration 1, loss/td: shipped 0.5, now None",
    ]


@pytest.mark.soak
@pytest.mark.parametrize("name", trained_again.commands())
def test_a_network_that_ships_is_learned_again_by_its_command(name: str) -> None:
    """Until its second iteration with updates."""
    learned = [k for k, line in enumerate(trained_again.log(TRAININGS / f"{name}-0")) if line["updates"]]
    assert trained_again.differences(name, learned[1] + 1) == []
