"""Learning curves: read from the logs of trainings, smoothed, and several seeds laid over one another."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import learning
from benchmarks.learning_curves import Course, Training, main, page, read, smoothed, together
from cosim.errors import BadInput


def training(folder: Path, crashed: list[float], seed: int = 0) -> Path:
    """A run's folder: missions known in every other iteration, validated in every fifth."""
    folder.mkdir()
    lines = []
    for k, value in enumerate(crashed):
        record = {"iteration": k, "train/crashed": value, "train/dt_mean_m": 600.0 + k}
        record |= {"train/mission_success": 1.0} if k % 2 else {}
        record |= {"valid/crashed": value / 2, "valid/dt_mean_m": 700.0} if k % 5 == 0 else {}
        lines.append(json.dumps(record))
    (folder / "log.jsonl").write_text("\n".join(lines) + "\n")
    (folder / "state.json").write_text(json.dumps({"config": {"seed": seed}}))
    return folder


def test_a_point_is_the_mean_of_the_iterations_up_to_it() -> None:
    course = smoothed(np.arange(6.0), np.array([0.0, 0.0, 3.0, 3.0, 3.0, 9.0]), 3)
    assert course.iteration.tolist() == [2, 3, 4, 5]
    assert course.value == pytest.approx([1.0, 2.0, 3.0, 5.0])
    short = smoothed(np.arange(2.0), np.array([1.0, 0.0]), 3)
    assert (short.iteration.tolist(), short.value.tolist()) == ([1.0], [0.5])


def test_seeds_are_compared_where_all_of_them_have_come_to() -> None:
    long = Course(np.array([0.0, 10.0, 20.0]), np.array([0.0, 1.0, 2.0]))
    late = Course(np.array([5.0, 15.0]), np.array([4.0, 6.0]))
    x, mean, low, high = together([long, late])
    assert x.tolist() == [10.0]
    assert (mean[0], low[0], high[0]) == pytest.approx((3.0, 1.0, 5.0))


def test_missing_figures_leave_gaps_and_no_zeros(tmp_path: Path) -> None:
    run = read(str(training(tmp_path / "vfn-p-3", [1.0] * 40, seed=3)))
    assert (run.label, run.seed, run.iterations) == ("vfn-p-3", 3, 40)
    served = run.courses["train", "mission_success"]
    assert set(served.iteration) <= {float(k) for k in range(1, 40, 2)}
    assert served.value == pytest.approx(np.ones(len(served.value)))
    assert ("valid", "mission_success") not in run.courses


def test_the_page_shows_first_and_last_over_the_seeds(tmp_path: Path) -> None:
    falling = [1.0] * 20 + [0.0] * 30
    runs = [
        training(tmp_path / "a", falling, 0),
        training(tmp_path / "b", [v / 2 for v in falling], 1),
        training(tmp_path / "c", [0.0] * 50, 2),
    ]
    texts = [*(f"vfn-p={r}" for r in runs[:2]), f"twin={runs[2]}"]
    lines = page([read(text) for text in texts], "a command")
    assert any(x.startswith("| vfn-p | 0, 1 | 50 | training | 75.0 (50.0 to 100.0); 0.0 |") for x in lines)
    assert "| twin | 2 | 50 | validation | 0.0; 0.0 |  | 700; 700 |" in lines


def test_page_csv_and_picture_are_written(tmp_path: Path) -> None:
    run = training(tmp_path / "run", [1.0, 0.0] * 20)
    out = tmp_path / "out" / "learning.md"
    assert main([f"vfn-p={run}", "--out", str(out)]) == 0
    assert "learning.png" in out.read_text()
    assert out.with_suffix(".png").stat().st_size > 5_000
    with out.with_suffix(".csv").open() as file:
        lines = list(csv.DictReader(file))
    valid = [x for x in lines if (x["drives"], x["figure"]) == ("valid", "crashed")]
    assert [(x["iteration"], x["value"]) for x in valid[:2]] == [("0", "0.5"), ("5", "0")]


def test_a_folder_without_a_training_is_refused_with_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(BadInput, match=r"log\.jsonl"):
        read(str(tmp_path))
    (tmp_path / "log.jsonl").write_text("not json\n")
    assert main([str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(("gain", "said"), [(0.3, "**Yes**"), (0.1, "**Not shown**")])
def test_the_mask_accelerates_learning_if_the_agent_gains_more_behind_it(gain: float, said: str) -> None:
    def trained(label: str, first: float, last: float) -> Training:
        courses = {key: Course(np.arange(2.0), np.array([first, last])) for key in learning.FIGURES}
        return Training(label, f"{label}-0", courses, 2, 0)

    masked, bare = trained(learning.MASKED, 0.6, 0.6 + gain), trained(learning.BARE, 0.1, 0.3)
    lines = learning.mask([masked, bare])
    assert said in "\n".join(lines)
    assert f"| `{learning.BARE}` | 10.0 to 30.0 |" in lines[-1]
    assert learning.mask([masked]) == []
