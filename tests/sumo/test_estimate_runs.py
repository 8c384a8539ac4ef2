"""`cosim estimate` as a user meets it: weighed episodes, runs that grow, a gate on the crash rate."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

from cosim.cli.main import main

SHORT = "--scenario merge --demand dense --policy idm --duration 12 --warmup 20 --workers 2"
OFTEN = """
inattention: {rate: 4.0e-3, duration: [1.0, 3.0]}
hard_braking: {rate: 2.0e-3, deceleration: [4.0, 7.0], duration: [0.8, 1.6]}
cut_in: {rate: 2.0e-2, deceleration: [3.0, 8.0]}
"""
TILT = "inattention=6,hard_braking=6,cut_in=4,inattention.other=3,hard_braking.other=3,during=2,untilted=0.2"
EPISODES = 60


def rows(folder: Path) -> list[dict[str, Any]]:
    table: list[dict[str, Any]] = pyarrow.parquet.read_table(folder / "episodes.parquet").to_pylist()
    return table


def run(command: str, *more: object) -> int:
    return main([*command.split(), *map(str, more)])


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("errors") / "often.yaml"
    file.write_text(OFTEN)
    return file


@pytest.fixture(scope="module")
def tilted(tmp_path_factory: pytest.TempPathFactory, errors: Path) -> Path:
    """A run of two episodes, that has grown."""
    out = tmp_path_factory.mktemp("runs") / "tilted"
    command = f"estimate {SHORT} --tilt {TILT} --errors {errors} --out {out}"
    assert run(command, "--episodes", 2) == 0
    assert run(f"estimate --resume --out {out} --workers 2 --episodes {EPISODES}") == 0
    return out


@pytest.fixture(scope="module")
def untilted(tmp_path_factory: pytest.TempPathFactory, errors: Path) -> Path:
    """The same seeds, drawn as errors happen, by `cosim evaluate`."""
    out = tmp_path_factory.mktemp("runs") / "untilted"
    seeds = f"200000:{200000 + EPISODES}"
    assert run(f"evaluate {SHORT} --errors {errors} --seeds {seeds} --no-report --out {out}") == 0
    return out


def test_a_run_grows_and_says_what_it_found(tilted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(f"estimate --resume --json --out {tilted}") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["episodes"] == EPISODES
    assert found["low"] <= found["crash_rate_per_million_km"] <= found["high"]
    assert 1.0 <= found["effective_samples"] <= EPISODES
    assert found["vehicle_km"] > found["av_km"] > 0.0
    assert (found["scenario"], found["policy"]) == ("merge", "idm")
    names = {"av_caused_crash_rate_per_million_km", "all_crash_rate_per_million_km"}
    assert names <= found["figures"].keys()
    manifest = json.loads((tilted / "manifest.json").read_text())
    assert manifest["seeds"] == [200000, 200000 + EPISODES]
    (cell,) = manifest["cells"].values()
    assert cell["case"]["tilt"] == cell["manifest"]["tilt"]
    assert run(f"estimate --resume --episodes 3 --out {tilted}") == 2
    assert "it can only get more seeds" in capsys.readouterr().err


def test_untilted_episodes_of_a_mixture_are_those_of_evaluate(tilted: Path, untilted: Path) -> None:
    plain = {row["seed"]: row["trace_hash"] for row in rows(untilted)}
    alike = [row["trace_hash"] == plain[row["seed"]] for row in rows(tilted) if not row["tilted"]]
    assert len(alike) >= 5
    assert all(alike)
    assert not all(row["trace_hash"] == plain[row["seed"]] for row in rows(tilted))


def test_weights_undo_the_tilt(tilted: Path, untilted: Path) -> None:
    """The mean weight is 1, and errors are as frequent as without a tilt: within three standard errors."""
    found, plain = rows(tilted), rows(untilted)
    weight = np.array([row["weight"] for row in found])
    erred, usual = (np.array([row["human_errors"] for row in each], float) for each in (found, plain))
    assert erred.mean() > 1.2 * usual.mean()
    spread = weight.std() / math.sqrt(EPISODES)
    assert weight.mean() == pytest.approx(1.0, abs=3.0 * spread)
    values = weight * erred
    off = math.hypot(values.std(), usual.std()) / math.sqrt(EPISODES)
    assert values.mean() == pytest.approx(usual.mean(), abs=3.0 * off)


def test_without_a_tilt_nothing_is_weighed(
    untilted: Path, errors: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Weighted and unweighted are equal, to the last digit."""
    out = tmp_path / "plain"
    command = f"estimate {SHORT} --tilt none --errors {errors} --episodes 4 --json --out {out}"
    assert run(command) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["tilted_episodes"], found["effective_samples"]) == (0, 4.0)
    same = [row["trace_hash"] for row in rows(untilted)][:4]
    assert [row["trace_hash"] for row in rows(out)] == same
    summary = json.loads((out / "summary.json").read_text())["groups"][0]
    for name, figure in found["figures"].items():
        assert summary["incidences"][name] == figure
    neutral = tmp_path / "neutral"
    command = f"estimate {SHORT} --tilt all=1 --errors {errors} --episodes 4 --json --out {neutral}"
    assert run(command) == 0
    assert json.loads(capsys.readouterr().out)["figures"] == found["figures"]
    assert [row["trace_hash"] for row in rows(neutral)] == same


def test_a_gate_holds_the_crash_rate(tilted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gate = "crash_rate_per_million_km.upper > 2"
    assert main(["compare", str(tilted), str(tilted), "--fail-on", gate]) == 1
    assert "upper bound is" in capsys.readouterr().out
    assert main(["compare", str(tilted), str(tilted), "--fail-on", "crash_rate_per_million_km > +1"]) == 0


def test_what_is_not_weighed_is_no_figure_of_tilted_episodes(tilted: Path) -> None:
    summary = json.loads((tilted / "summary.json").read_text())["groups"][0]
    assert summary["rates"] == summary["means"] == {}
    assert main(["compare", str(tilted), str(tilted), "--fail-on", "collision_rate > 1%"]) == 2


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--tilt cut_in=2", "--episodes"),
        ("--episodes 2 --tilt cutin=2", "did you mean 'cut_in'"),
        ("--episodes 2 --tilt cut_in=0.5", "1 or more"),
    ],
)
def test_bad_input_leaves_nothing(
    flags: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert run(f"estimate --scenario merge {flags} --errors stress --out {out}") == 2
    assert said in capsys.readouterr().err
    assert not out.exists()


def test_a_spec_without_errors_is_estimated_without_errors(tmp_path: Path) -> None:
    spec = tmp_path / "none.yaml"
    spec.write_text(
        "scenario: merge\ndemand: free\npolicy: idm\nduration: 4\nwarmup: 4\nerrors: none\n"
        'seeds: "140000:140002"\n'
    )
    assert run(f"estimate {spec} --workers 1 --out {tmp_path}/out") == 0
    assert {row["errors"] for row in rows(tmp_path / "out")} == {None}
