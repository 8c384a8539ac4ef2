"""How forecasts are scored: by episode, in metres, and their intervals by what they cover."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cosim.files import write_csv
from cosim.learning.bench_predict import markdown, paired, plot
from cosim.learning.prediction_scores import Predicted, Scores, interval_errors, position_error

STEPS = 20


def truth(count: int = 4) -> np.ndarray:
    """[S,20,4] cars that drive north at 10 m/s."""
    future = np.zeros((count, STEPS, 4))
    future[:, :, 1] = 2.0 * np.arange(1, STEPS + 1)
    future[:, :, 2], future[:, :, 3] = 10.0, np.pi / 2
    return future


def predicted(future: np.ndarray, ahead: float = 0.0, left: float = 0.0, std: float = 0.0) -> Predicted:
    """The truth, but so far ahead and to the left of it."""
    spread = np.full(future.shape[:2], std)
    return Predicted(
        future[:, :, 0] - left,
        future[:, :, 1] + ahead,
        future[:, :, 2],
        future[:, :, 3] - 2 * np.pi,  # a whole turn off is not off
        (spread, spread, spread, spread),
    )


def test_the_error_is_a_distance_and_splits_into_along_and_across() -> None:
    future = truth()
    future[1, 5:] = np.nan  # it left
    guess = predicted(truth(), 3.0, 4.0)
    error = position_error(guess, future)
    np.testing.assert_allclose(error[0], 5.0)
    assert np.isnan(error[1, 5:]).all()
    speed, heading, along, across = interval_errors(guess, future)
    np.testing.assert_allclose(speed[0], 0.0)
    np.testing.assert_allclose(heading[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(along[0], -3.0)
    np.testing.assert_allclose(across[0], -4.0)


def scored() -> Scores:
    """Two worlds, one of them with three times as many episodes; `off` errs by 1 m here and 3 m there."""
    scores = Scores(STEPS, 0.2)
    rng = np.random.default_rng(0)
    for world, error, count in (("exit", 1.0, 3), ("merge", 3.0, 1)):
        for _ in range(count):
            future = truth(2000)
            noisy = future.copy()
            noisy[:, :, 1] += rng.normal(0.0, 2.0, future.shape[:2])
            good = predicted(future, std=2.0)
            scores.add(
                {"scenario": world, "behavior": "mixed"},
                noisy,
                {"gp-indirect": good, "off": predicted(noisy, error)},
            )
    return scores


def test_every_scenario_counts_the_same_however_many_episodes_it_has() -> None:
    rows = {
        (r["predictor"], r["scenario"], r["behavior"], r["horizon_s"]): r for r in scored().position_table()
    }
    assert rows["off", "exit", "mixed", 1.0]["mean_m"] == pytest.approx(1.0)
    assert rows["off", "merge", "all", "mean"]["mean_m"] == pytest.approx(3.0)
    assert rows["off", "all", "all", 4.0]["mean_m"] == pytest.approx(2.0)
    assert rows["off", "all", "all", 4.0]["n"] == 8000
    assert rows["off", "all", "all", "mean"]["n"] == 8000 * STEPS
    assert {key[3] for key in rows} == {0.2, 0.4, 1.0, 2.0, 3.0, 4.0, "mean"}


def test_intervals_that_are_right_cover_what_they_promise() -> None:
    rows = [r for r in scored().coverage_table() if r["scenario"] == "all"]
    assert {r["predictor"] for r in rows} == {"gp-indirect"}, "who gives no interval is not judged"
    along = [r for r in rows if r["quantity"] == "along"]
    assert len(along) == 6
    for row in along:
        assert row["coverage"] == pytest.approx(0.9, abs=0.02)
        assert row["width"] == pytest.approx(2 * 1.645 * 2.0)
    assert all(r["coverage"] == 1.0 for r in rows if r["quantity"] == "speed")


def test_the_difference_to_the_gaussian_process_is_taken_on_the_same_episodes() -> None:
    found = paired(scored())["off"]
    assert found["merge"]["value"] == pytest.approx(3.0 - 1.6, abs=0.05)


def test_tables_and_plot_are_written(tmp_path: Path) -> None:
    scores = scored()
    positions, coverage = scores.position_table(), scores.coverage_table()
    text = markdown(scores, positions, coverage, "cosim bench predict")
    assert "| off | 1.000" in text
    assert "| gp-indirect | along |" in text
    write_csv(tmp_path / "x.csv", positions)
    lines = (tmp_path / "x.csv").read_text().splitlines()
    assert lines[0] == "predictor,scenario,behavior,horizon_s,mean_m,ci_low,ci_high,n"
    assert len(lines) == len(positions) + 1
    plot(tmp_path / "x.png", scores)
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
