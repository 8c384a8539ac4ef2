"""The tilts of `cosim estimate`, and what its intervals are worth: a toy of known truth, brute force, speed.

    python -m benchmarks.estimate tune --world merge --runs runs/tilts [--episodes 400] [--rounds 4]

`tune` drives tilted episodes of `idm` AVs on tuning seeds, and lets the tilt become that under which errors
are as frequent as in those episodes in which an AV crashed (cross-entropy; docs/estimate.md); it prints the
tilt for sumo_scenarios/tilts.yaml.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cosim.cli.main import main as cosim
from cosim.report import run_folder
from cosim.report.figures import Row, weights
from cosim.report.statistics import effective
from cosim.scenario.tilt import ALL, OTHER, Tilt
from cosim.seeding import TUNING_SEEDS
from cosim.workers.tasks import OK

Array = npt.NDArray[np.float64]
FIRST = 2.0  # errors a tilted episode that the first tilt aims at, if none ended the trials
DURING = 10.0  # the second error has a tenth of the time and of the drivers of the first
TEMPER = 0.5  # power of the weights of crashed episodes: fewer of them decide everything
KEPT = 0.2  # of the tilt before, in units of one crashed episode
HUMANS = 0.2  # share of the score that crashes among humans have


def drive(
    folder: Path, world: str, demand: str, errors: str, tilt: Tilt, seeds: range, workers: int
) -> list[Row]:
    """The episodes of `idm` AVs under a tilt; what is in the folder already is not driven again."""
    flags = {
        "--scenario": world,
        "--demand": demand,
        "--errors": errors,
        "--tilt": tilt.text(),
        "--seeds": f"{seeds.start}:{seeds.stop}",
        "--episodes": len(seeds),
        "--workers": workers,
        "--out": folder,
    }
    words = [str(word) for flag in flags.items() for word in flag]
    if cosim(["estimate", *words, *(["--resume"] if folder.exists() else [])]):
        raise SystemExit(f"{folder}: not every episode could be driven")
    return [row for row in run_folder.read(folder).rows if row["status"] == OK]


def trials(rows: Sequence[Row]) -> dict[str, Array]:
    """Case -> [2,n] errors begun and sum of their probabilities in each episode."""
    each = [json.loads(row["tilt_trials"]) for row in rows]
    names = sorted({name for found in each for name in found})
    return {name: np.array([found.get(name, (0, 0.0)) for found in each], float).T for name in names}


def balanced(rows: Sequence[Row], before: Tilt) -> Tilt:
    """Every case is drawn equally often, `FIRST` errors an episode in all."""
    known = {name: expected.mean() for name, (_, expected) in trials(rows).items()}
    return replace(before, factors={n: max(FIRST / len(known) / e, 1.0) for n, e in known.items()})


def crossed(rows: Sequence[Row], before: Tilt) -> Tilt:
    """Every case as frequent as in the crashed episodes, by their weights; shrunk towards the tilt before."""
    weight = np.array(weights(rows)) ** TEMPER
    score = np.zeros(len(rows))
    for share, column in ((1.0 - HUMANS, "av_involved_collisions"), (HUMANS, "hv_hv_collisions")):
        hit = weight * np.array([row[column] > 0 for row in rows])
        score += share * hit / hit.sum() if hit.any() else 0.0
    factors = dict(before.factors)
    for name, (begun, expected) in trials(rows).items():
        usual, was = expected.mean(), before.factors.get(name, 1.0)
        if not usual > 0.0:
            continue
        new = (score @ begun + KEPT * was * usual) / (score @ expected + KEPT * usual)
        factors[name] = max(float(new), 1.0)
    return replace(before, factors=factors)


def needed(rows: Sequence[Row], half_width: float = 0.5) -> float:
    """Episodes for a 95 % interval of about +- `half_width` of the crash rate, by the variance of these."""
    w = np.array(weights(rows))
    y, k = (np.array([float(row[name]) for row in rows]) for name in ("av_involved_collisions", "av_km"))
    events = float((w * y).sum())
    rate = events / float((w * k).sum())
    return (
        float((1.96 / half_width) ** 2 * (w**2 * (y - rate * k) ** 2).sum() / events**2 * len(rows))
        if events
        else np.inf
    )


def tune(world: str, demand: str, errors: str, runs: Path, episodes: int, rounds: int, workers: int) -> Tilt:
    """The tilt after the last round; every round has seeds of its own."""
    tilt = Tilt({ALL: 2.0, ALL + OTHER: 2.0}, DURING)
    for k in range(rounds):
        seeds = range(TUNING_SEEDS.start + k * episodes, TUNING_SEEDS.start + (k + 1) * episodes)
        rows = drive(runs / f"{world}-{k}", world, demand, errors, tilt, seeds, workers)
        crashes = np.array(weights(rows))[[row["av_involved_collisions"] > 0 for row in rows]]
        said = f"{len(crashes)} crashes, effective {effective(crashes):.1f}, needed {needed(rows):.3g}"
        print(f"round {k}: {said}")
        tilt = crossed(rows, tilt) if k else balanced(rows, tilt)
        tilt = replace(tilt, factors={name: float(f"{f:.2g}") for name, f in tilt.factors.items()})
        print(tilt.text())
    return tilt


def main() -> None:
    """One of the commands."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    tuning = commands.add_parser("tune")
    tuning.add_argument("--world", required=True)
    tuning.add_argument("--demand", default="dense")
    tuning.add_argument("--errors", default="field")
    tuning.add_argument("--runs", type=Path, required=True)
    tuning.add_argument("--episodes", type=int, default=400)
    tuning.add_argument("--rounds", type=int, default=5)
    tuning.add_argument("--workers", type=int, default=2)
    tuning.set_defaults(work=tune)
    args = vars(parser.parse_args())
    args.pop("work")(**args)


if __name__ == "__main__":
    main()
