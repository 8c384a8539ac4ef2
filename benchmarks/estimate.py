"""Tilts for `cosim estimate`, and validity of its intervals: a toy model, brute force, speed.

    python -m benchmarks.estimate tune --world merge --runs runs/tilts [--episodes 400 400 3000 2000]
    python -m benchmarks.estimate measure --runs runs/estimate [--worlds merge] [--episodes 4000]
    python -m benchmarks.estimate page --runs runs/estimate [--out PAGE] [--intervals 400]

`tune` drives tilted episodes of `idm` AVs on validation seeds. It raises the probabilities of errors by the
weight of the crashes after them (estimate.md), and prints the tilt for sumo_scenarios/tilts.yaml. `measure`
drives the episodes of `page` on test seeds: a case within reach of brute force, with and without a tilt, and
`dense` at the level `field`. Both resume. `page` adds the toy model and writes docs/results/estimate.md.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.tables import markdown_row, write_page
from benchmarks.toy_crashes import KINDS, Toy
from cosim.cli.main import main as cosim
from cosim.report import crash_rate, run_folder, wording
from cosim.report.figures import CRASHES, INCIDENCES, Row, weights
from cosim.report.statistics import effective, pooled_rate
from cosim.scenario.tilt import ALL, OTHER, SECOND, Tilt, shipped
from cosim.seeding import FIRST_EXAMPLE_SEED, TUNING_SEEDS
from cosim.workers.tasks import OK

Array = npt.NDArray[np.float64]
FIRST = 0.4  # target of the first rounds: errors per tilted episode; few, to leave room for rare kinds
NEAR_AV = 0.75  # share of these errors that affect an AV first
FOLLOW = 0.3  # target: second errors per episode with a first error
FOLLOWING = ("inattention", "hard_braking")  # kinds likely to interact with another error within seconds
ROUNDS = (400, 400, 3000, 2000)  # episodes; the first rounds do not need crashes
BALANCED = 2  # rounds that make all kinds equally frequent, before crashes are evaluated
DURING = 10.0  # initially: a second error has a tenth of the first one's time and drivers
PAGE = Path("docs/results/estimate.md")
INTERVALS = 400
REAL = ("exit", "contested", "stress")  # scenario, demand, errors: AV crashes within reach of brute force
REAL_TILT = Tilt({ALL: 3.0, ALL + OTHER: 2.0}, 2.0, 0.1)
FRESH = FIRST_EXAMPLE_SEED + 10_000  # first seed for level `field`; results on earlier seeds were known
BRUTE, REPETITIONS, EACH = 1600, 40, 40  # episodes; estimates, and episodes per estimate
UNSEEN = 0.5  # pseudo-crashes added to every case
FIRST_WITH, FOLLOW_WITH = 1.0, 0.7  # as FIRST and FOLLOW, in rounds that evaluate crashes


def drive(
    folder: Path, world: str, demand: str, errors: str, tilt: Tilt | None, seeds: range, workers: int
) -> list[Row]:
    """The episodes of `idm` AVs under a tilt; episodes already in the folder are not driven again."""
    flags = {
        "--scenario": world,
        "--demand": demand,
        "--errors": errors,
        "--tilt": "none" if tilt is None else tilt.text(),
        "--seeds": f"{seeds.start}:{seeds.stop}",
        "--episodes": len(seeds),
        "--workers": workers,
        "--out": folder,
    }
    words = [str(word) for flag in flags.items() for word in flag]
    if cosim(["estimate", *words, *(["--resume"] if folder.exists() else [])]):
        raise SystemExit(f"{folder}: not every episode could be driven")
    return _ok(folder)


def trials(rows: Sequence[Row]) -> dict[str, Array]:
    """Case -> [2,n] errors begun and sum of their probabilities in each episode."""
    each = [json.loads(row["tilt_trials"]) for row in rows]
    names = sorted({name for found in each for name in found})
    return {name: np.array([found.get(name, (0, 0.0)) for found in each], float).T for name in names}


def balanced(rows: Sequence[Row], before: Tilt) -> Tilt:
    """The tilt for `FIRST` errors per episode, equally many of each kind, and a share `NEAR_AV` near an AV.

    Second errors are of the kinds `FOLLOWING`, with `FOLLOW` per episode with a first error.
    """
    factors: dict[str, float] = {}
    found = trials(rows)
    begun = begun_first(found, len(rows))
    for ending, aim in (("", FIRST * NEAR_AV), (OTHER, FIRST * (1.0 - NEAR_AV)), (SECOND, FOLLOW)):
        of = begun if ending == SECOND else np.ones(len(rows), bool)  # episodes with possible errors
        names = [n for n in found if ending == ending_of(n)]
        if ending == SECOND:
            names = [n for n in names if n.removesuffix(SECOND) in FOLLOWING]
        expected = {n: found[n][1][of].mean() for n in names}
        factors |= {n: max(aim / len(expected) / e, 1.0) for n, e in expected.items() if e > 0.0}
    return replace(before, factors=factors, during=1.0)


def ending_of(name: str) -> str:
    """The part of a `cosim.scenario.tilt.case` after the kind."""
    return "".join(name.partition(".")[1:])


def allotted(rows: Sequence[Row], before: Tilt) -> Tilt:
    """The tilt with the smallest variance for a given number of errors.

    A case with factor f begins in n episodes, where n is proportional to f. Its variance is S, the sum of
    squared weights of the subsequent crashes, proportional to 1 / f. For a fixed total of errors, sqrt(S / n)
    is the best change of f (Neyman allocation). S includes half a crash of mean weight, since no observed
    crash does not mean none. A factor that most trials do not follow (q at its maximum, or trials ended
    before) is not raised. Without any crash the tilt stays.
    """
    squares = np.array(weights(rows)) ** 2
    crashed = np.array([row["av_involved_collisions"] > 0 for row in rows])
    if not crashed.any():
        return before
    unseen = UNSEEN * squares[crashed].mean()
    factors, found = dict(before.factors), trials(rows)
    first = int(begun_first(found, len(rows)).sum())
    for aim, second in ((FIRST_WITH, False), (FOLLOW_WITH, True)):
        begun = {n: b > 0 for n, (b, _) in found.items() if n.endswith(SECOND) == second}
        begun = {n: b for n, b in begun.items() if b.any()}
        change = {n: math.sqrt((squares[b & crashed].sum() + unseen) / b.sum()) for n, b in begun.items()}
        changed = sum(begun[n].sum() * change[n] for n in begun)  # errors after the unscaled change
        wanted = aim * (first if second else len(rows))
        for name, by in change.items():
            kind = name.removesuffix(SECOND)
            was = before.factors.get(name, before.factors.get(kind, 1.0) * before.during)
            new = max(float(was * by * wanted / changed), 1.0)
            follows = found[name][0].sum() > 0.5 * was * found[name][1].sum()
            factors[name] = new if follows else min(new, was)
    return replace(before, factors=factors)


def begun_first(found: Mapping[str, Array], episodes: int) -> npt.NDArray[np.bool_]:
    """[n] whether a first error near an AV began in each episode with these `trials`."""
    of_first = [begun for name, (begun, _) in found.items() if not name.endswith(SECOND)]
    return np.array(np.sum([np.zeros(episodes), *of_first], 0) > 0)


def tune(world: str, demand: str, errors: str, runs: Path, episodes: Sequence[int], workers: int) -> Tilt:
    """The tilt after the last round; `episodes`: per round, on separate seeds."""
    tilt = Tilt({ALL: 2.0, ALL + OTHER: 2.0}, DURING)
    first = TUNING_SEEDS.start
    for k, count in enumerate(episodes):
        seeds = range(first, first + count)
        first = seeds.stop
        rows = drive(runs / f"{world}-{k}", world, demand, errors, tilt, seeds, workers)
        crashes = np.array(weights(rows))[[row["av_involved_collisions"] > 0 for row in rows]]
        print(f"round {k}: {len(crashes)} crashes, effective {effective(crashes):.1f}, {len(rows)} episodes")
        tilt = balanced(rows, tilt) if k < BALANCED else allotted(rows, tilt)
        tilt = replace(tilt, factors={name: float(f"{f:.2g}") for name, f in tilt.factors.items()})
        print(tilt.text())
    return tilt


def measure(runs: Path, worlds: Sequence[str], episodes: int, workers: int) -> None:
    """Drive the episodes of the page."""
    for name, tilt, count in (("brute", None, BRUTE), ("tilted", REAL_TILT, REPETITIONS * EACH)):
        first = FIRST_EXAMPLE_SEED + (BRUTE if name == "tilted" else 0)
        drive(runs / name, *REAL, tilt, range(first, first + count), workers)
    for world in worlds:
        tilt = shipped(world)
        if tilt is None:
            raise SystemExit(f"{world} has no tilt: sumo_scenarios/tilts.yaml")
        seeds = range(FRESH, FRESH + episodes)
        drive(runs / f"field-{world}", world, "dense", "field", tilt, seeds, workers)


def page(runs: Path, out: Path, intervals: int) -> None:
    """Write the page from the toy model (`intervals` estimates per line) and the results of `measure`."""
    lines = ["# Coverage of the intervals of `cosim estimate`", ""]
    lines += ["Made by `python -m benchmarks.estimate page`. [Method](../guides/estimate.md).", ""]
    write_page(out, [*lines, *_toy(intervals), *_real(runs), *_field(runs)])


def _toy(intervals: int) -> list[str]:
    """Coverage of `intervals` intervals, for several tilts and sizes."""
    toy = Toy()
    truth = toy.truth()
    lines = [
        "## A toy model of known crash rate",
        "",
        f"Two kinds of errors cause crashes together; a third, rare kind causes crashes alone "
        f"(`benchmarks/toy_crashes.py`). The true rate is {1e6 * truth:.1f} crashes per million km. "
        f"Each line has {intervals} estimates.",
        "",
        markdown_row(
            ("tilt", "episodes each", "crashes each", "effective", "95 % intervals with the true rate",
             "true rate above, below", "mean / true rate", "half width / true rate (median)")
        ),
        "|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for factor, episodes in ((1, 2000), (30, 1000), (100, 300), (100, 1000), (100, 2000), (300, 1000)):
        tilt = Tilt(dict.fromkeys(KINDS, float(factor)))
        each = [*zip(*toy.drive((intervals, episodes), tilt, factor * episodes), strict=True)]
        found = [pooled_rate(*parts) for parts in each]
        below, above = (np.mean([f.high < truth for f in found]), np.mean([f.low > truth for f in found]))
        values = np.array([f.value for f in found]) / truth
        error = values.std() / math.sqrt(len(values))
        cells = (
            f"{factor}", f"{episodes}", f"{np.mean([y.sum() for y, _, _ in each]):.1f}",
            f"{np.mean([effective(w[y > 0]) for y, _, w in each]):.1f}",
            f"{100 * (1 - below - above):.1f} %", f"{100 * below:.1f} %, {100 * above:.1f} %",
            f"{values.mean():.3f} ± {1.96 * error:.3f}",
            f"{np.median([(f.high - f.low) / 2 for f in found]) / truth:.2f}",
        )  # fmt: skip
        lines.append(markdown_row(cells))
    return [*lines, ""]


def _real(runs: Path) -> list[str]:
    """Comparison of brute force with repetitions of the tilted estimate."""
    if not ((runs / "brute").is_dir() and (runs / "tilted").is_dir()):
        return []
    brute, tilted = (_ok(runs / name) for name in ("brute", "tilted"))
    known = INCIDENCES[CRASHES]
    truth = known.figure(brute)
    each = [known.figure(tilted[k : k + EACH]) for k in range(0, len(tilted), EACH)]
    values = np.array([f.value for f in each])
    scatter, of_brute = float(values.std(ddof=1)), (truth.high - truth.low) / 2 / 1.96
    error = math.hypot(scatter / math.sqrt(len(values)), of_brute)
    held = sum(f.low <= truth.value <= f.high for f in each)
    world, demand, errors = REAL
    return [
        f"## {world}, {demand}, errors {errors}: brute force and tilt",
        "",
        f"`idm` AVs, test seeds. Brute force, {len(brute)} episodes: {wording.interval(truth, known)}, "
        f"standard error {of_brute:.0f}. {len(each)} tilted estimates of {EACH} episodes "
        f"(`{REAL_TILT.text()}`): mean {values.mean():.0f}, standard deviation {scatter:.0f}. The standard "
        f"error of brute force is {of_brute / scatter:.2f} of that. Difference "
        f"{values.mean() - truth.value:+.0f} ± {1.96 * error:.0f}: "
        f"{abs(values.mean() - truth.value) / error:.1f} standard errors. {held} of {len(each)} intervals "
        f"contain the rate of brute force.",
        "",
    ]


def _field(runs: Path) -> list[str]:
    """Cost of the level `field`, and its tilts."""
    folders = sorted(runs.glob("field-*"))
    if not folders:
        return []
    lines = [
        "## `dense` at the level `field`, `idm` AVs",
        "",
        markdown_row(
            ("scenario", "episodes", "crashes per million AV-km", "AV-caused", "all, per million vehicle-km",
             "crashed episodes, effective", "effective samples", "largest weight of the crashed",
             "episodes for +-50 %", "s each", "hours of two cores for +-50 %")
        ),
        "|" + "---|" * 11,
    ]  # fmt: skip
    tilts: list[str] = []
    for folder in folders:
        rows = _ok(folder)
        found = crash_rate.estimate(rows)
        seconds = float(np.mean([row["total_s"] for row in rows]))
        intervals = [
            wording.interval(INCIDENCES[n].figure(rows), INCIDENCES[n]) for n in INCIDENCES if CRASHES in n
        ]
        share, world = found["largest_crash_share"], folder.name.removeprefix("field-")
        (cell,) = run_folder.read(folder).manifest["cells"].values()
        tilts.append(f"Tilt of {world}: `{cell['manifest']['tilt']}`.")
        many = crash_rate.needed(rows)
        lines.append(
            markdown_row(
                (world, f"{len(rows)}", *intervals,
                 f"{found['crashed_episodes']}, {found['effective_crashes']:.1f}",
                 f"{found['effective_samples']:.0f}", "-" if share is None else f"{100 * share:.0f} %",
                 f"{many:.0f}", f"{seconds:.2f}", f"{many * seconds / 7200:.1f}")
            )
        )  # fmt: skip
    return [*lines, "", *tilts, ""]


def _ok(folder: Path) -> list[Row]:
    return [row for row in run_folder.read(folder).rows if row["status"] == OK]


def main() -> None:
    """Run one of the commands."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    tuning = commands.add_parser("tune")
    tuning.add_argument("--world", required=True)
    tuning.add_argument("--demand", default="dense")
    tuning.add_argument("--errors", default="field")
    tuning.add_argument("--runs", type=Path, required=True)
    tuning.add_argument("--episodes", type=int, nargs="+", default=ROUNDS, help="of every round")
    tuning.add_argument("--workers", type=int, default=2)
    tuning.set_defaults(work=tune)
    measuring = commands.add_parser("measure")
    measuring.add_argument("--runs", type=Path, required=True)
    measuring.add_argument("--worlds", nargs="*", default=["merge"])
    measuring.add_argument("--episodes", type=int, default=4000)
    measuring.add_argument("--workers", type=int, default=2)
    measuring.set_defaults(work=measure)
    writing = commands.add_parser("page")
    writing.add_argument("--runs", type=Path, required=True)
    writing.add_argument("--out", type=Path, default=PAGE)
    writing.add_argument("--intervals", type=int, default=INTERVALS)
    writing.set_defaults(work=page)
    args = vars(parser.parse_args())
    args.pop("work")(**args)


if __name__ == "__main__":
    main()
