"""Fidelity of SUMO's LC2013 to Table II: comparison with cosim's MOBIL, and calibration to it.

python -m benchmarks.behaviors --report      # test seeds; rewrites docs/results/behaviors.md
python -m benchmarks.behaviors --calibrate   # validation seeds; rewrites lc2013 in behaviors.yaml
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import Bounds, differential_evolution

from benchmarks.lane_changes import CLASSES, Traffic, build_highway, measure
from benchmarks.tables import markdown_row
from cosim.report.statistics import NA, Figure, quantile, rate, share
from cosim.scenario.behaviors import LC2013, MIXED, MOBIL, Behaviors, load_behaviors
from cosim.seeding import FIRST_EXAMPLE_SEED, TUNING_SEEDS
from sumo_scenarios import BEHAVIORS

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results" / "behaviors.md"

# ---------------------------------------------------------------- calibration

FORMULAS = {  # the uncalibrated mapping: b_safe -> lcAssertive, a_th -> lcSpeedGain
    "aggressive": {"lcAssertive": 1.31, "lcSpeedGain": 20.0, "lcSpeedGainLookahead": 0.0},
    "moderate": {"lcAssertive": 1.41, "lcSpeedGain": 3.33, "lcSpeedGainLookahead": 0.0},
    "conservative": {"lcAssertive": 1.41, "lcSpeedGain": 0.95, "lcSpeedGainLookahead": 0.0},
}

# Free attributes and their bounds; lcSpeedGain is searched by its logarithm. lcAssertive is not free: it also
# governs mandatory changes (merges, exits), where MOBIL has only b_safe and the formula is exact.
# lcCooperative is p; it has no effect on a highway without merges.
FREE = {"lcSpeedGain": (-2.0, 3.0), "lcSpeedGainLookahead": (0.0, 10.0)}
TUNING_DURATION = {"aggressive": 240.0, "moderate": 240.0, "conservative": 1800.0}  # s, long for rare changes
# Target for the share of changes with an egoistic incentive. For (nearly) egoistic drivers almost the share
# of MOBIL (0.99, 0.91); for p = 1 the required 70 % and a margin.
WANTED_SHARE = {"aggressive": 0.9, "moderate": 0.9, "conservative": 0.75}
WORST_UNSAFE = 0.02


def median_of_blocks(samples: Sequence[tuple[int, float]]) -> Figure:
    """Median of autocorrelated (block, value) samples: percentile bootstrap over whole blocks (minutes)."""
    blocks: dict[int, list[float]] = {}
    for block, value in samples:
        blocks.setdefault(block, []).append(value)
    parts = [np.asarray(v) for v in blocks.values()]
    if not parts:
        return NA
    rng = np.random.default_rng(0)
    medians = [
        np.median(np.concatenate([parts[i] for i in rng.integers(0, len(parts), len(parts))]))
        for _ in range(200)
    ]
    value = float(np.median(np.concatenate(parts)))
    return Figure(value, float(np.quantile(medians, 0.025)), float(np.quantile(medians, 0.975)))


def with_attributes(behaviors: Behaviors, name: str, values: Mapping[str, float]) -> Behaviors:
    """The behaviors with some LC2013 attributes of one class replaced."""
    driver = behaviors.classes[name]
    lc2013 = tuple({**dict(driver.lc2013), **values}.items())
    return replace(behaviors, classes={**behaviors.classes, name: replace(driver, lc2013=lc2013)})


def summary(traffic: Traffic, name: str) -> dict[str, float]:
    """The values compared by the calibration; nan for a class without lane changes."""
    changes = [c for c in traffic.changes if c.driver == name]
    values: dict[str, float] = {"rate": (len(changes) + 0.5) / traffic.kilometres[name]}
    for key in ("front_gap", "rear_gap", "imposed"):
        numbers = [getattr(c, key) for c in changes if not math.isnan(getattr(c, key))]
        for q in (10, 50, 90):
            values[f"{key}_{q}"] = float(np.percentile(numbers, q)) if numbers else math.nan
    count = max(1, len(changes))
    values["egoistic"] = sum(c.worth_egoistic for c in changes) / count
    values["unsafe"] = sum(not c.safe for c in changes) / count
    return values


def loss(found: Mapping[str, float], wanted: Mapping[str, float], b_safe: float, least_share: float) -> float:
    """Squared distance from the MOBIL reference: log rate, log gaps, imposed deceleration per b_safe.

    Penalties keep egoistic changes above the share `least_share`, breaches of b_safe below WORST_UNSAFE.
    """
    gaps = [f"{side}_gap_{q}" for side in ("front", "rear") for q in (10, 50)]
    terms = [math.log(found["rate"] / wanted["rate"]) ** 2]
    terms += [math.log(max(found[g], 0.1) / max(wanted[g], 0.1)) ** 2 for g in gaps]
    terms += [((found[f"imposed_{q}"] - wanted[f"imposed_{q}"]) / b_safe) ** 2 for q in (50, 90)]
    total = sum(9.0 if math.isnan(t) else t for t in terms)
    total += 100.0 * max(0.0, least_share - found["egoistic"]) ** 2
    return total + 100.0 * max(0.0, found["unsafe"] - WORST_UNSAFE) ** 2


def calibrate(
    folder: Path, names: Sequence[str], cache_file: Path, population: int, generations: int
) -> None:
    """Fit each class on validation seeds and write behaviors.yaml. Evaluations are cached, so an interrupted
    run continues; the search itself is deterministic."""
    cache: dict[str, dict[str, float]] = json.loads(cache_file.read_text()) if cache_file.exists() else {}
    behaviors = load_behaviors()

    def evaluate(name: str, model: str, values: Mapping[str, float]) -> dict[str, float]:
        key = json.dumps([name, model, {k: round(v, 4) for k, v in sorted(values.items())}])
        if key not in cache:
            changed = with_attributes(behaviors, name, values)
            traffic = measure(folder, name, model, TUNING_SEEDS.start, TUNING_DURATION[name], changed)
            cache[key] = summary(traffic, name)
            cache_file.write_text(json.dumps(cache, indent=0))
        return cache[key]

    for name in names:
        started = time.perf_counter()
        wanted = evaluate(name, MOBIL, {})
        b_safe, least_share = behaviors.classes[name].mobil.safe_deceleration, WANTED_SHARE[name]

        def decode(x: npt.NDArray[np.float64]) -> dict[str, float]:
            values = dict(zip(FREE, map(float, x), strict=True))
            return {k: round(10.0**v if k == "lcSpeedGain" else v, 3) for k, v in values.items()}

        def objective(x: npt.NDArray[np.float64], /, *_: object) -> float:
            return loss(evaluate(name, LC2013, decode(x)), wanted, b_safe, least_share)  # noqa: B023  called in this iteration only

        start = FORMULAS[name]
        x0 = np.array([math.log10(start["lcSpeedGain"]), start["lcSpeedGainLookahead"]])
        result = differential_evolution(
            objective,
            Bounds(*np.array([*FREE.values()]).T),
            x0=x0,
            seed=TUNING_SEEDS.start,
            popsize=population,
            maxiter=generations,
            polish=False,
        )
        best = decode(result.x)
        found = evaluate(name, LC2013, best)
        write_attributes(BEHAVIORS, name, best)
        print(f"{name}: {best}, loss {result.fun:.3f} (start {objective(x0):.3f}), b_safe {b_safe:g}")
        for key, value in found.items():
            print(f"    {key:14s} LC2013 {value:8.3f}   MOBIL {wanted[key]:8.3f}")
        print(f"    {result.nfev} evaluations, {time.perf_counter() - started:.0f} s", file=sys.stderr)


def write_attributes(path: Path, name: str, values: Mapping[str, float]) -> None:
    """Replace numbers in one class's lc2013 block; the rest of the file, with its comments, stays."""
    text = path.read_text(encoding="utf-8")
    head, block, tail = re.split(rf"(?m)^(  {name}:\n(?:    .*\n)+)", text, maxsplit=1)
    for key, value in values.items():
        block, count = re.subn(rf"(?m)^(      {key}: )[^\s#]+", rf"\g<1>{value:g}", block)
        if count != 1:
            raise ValueError(f"{path}: {name} has {count} lines for {key}")
    path.write_text(head + block + tail, encoding="utf-8")


# ---------------------------------------------------------------- report

# s per test seed, two seeds each: the whole report takes about three minutes on one core.
REPORT_DURATION = {"aggressive": 100.0, "moderate": 200.0, "conservative": 3000.0, MIXED: 240.0}
COLUMNS = (
    *("class", "traffic", "model", "changes", "per vehicle-km", "incentive > a_th, egoistic, %", "with p, %"),
    *("break b_safe, %", "front gap, m", "rear gap, m", "headway, s"),
)
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def report(folder: Path, scale: float) -> str:
    """Measure on test seeds; return the Markdown tables."""
    behaviors = load_behaviors()

    def collect(behavior: str, model: str, used: Behaviors) -> Traffic:
        total = Traffic()
        for seed in (FIRST_EXAMPLE_SEED, FIRST_EXAMPLE_SEED + 1):
            total.add(measure(folder, behavior, model, seed, scale * REPORT_DURATION[behavior], used))
        return total

    rows: list[tuple[str, str, str, Traffic]] = []
    for name in CLASSES:
        formulas = with_attributes(behaviors, name, FORMULAS[name])
        rows += [
            (name, name, "MOBIL", collect(name, MOBIL, behaviors)),
            (name, name, "LC2013", collect(name, LC2013, behaviors)),
            (name, name, "LC2013, formulas", collect(name, LC2013, formulas)),
        ]
    polite = with_attributes(behaviors, "conservative", {"lcAssertive": 0.5, "lcSpeedGain": 10.0})
    rows.append(
        ("conservative", "conservative", "LC2013, lcAssertive 0.5", collect("conservative", LC2013, polite))
    )
    for model, label in ((MOBIL, "MOBIL"), (LC2013, "LC2013")):
        traffic = collect(MIXED, model, behaviors)
        rows += [(name, MIXED, label, traffic) for name in CLASSES]

    lines = [markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))]
    for name, traffic_name, label, traffic in rows:
        changes = [c for c in traffic.changes if c.driver == name]
        n = len(changes)
        shares = (
            share(sum(of), n).text(0, 100.0)
            for of in (
                (c.worth_egoistic for c in changes),
                (c.worth for c in changes),
                (not c.safe for c in changes),
            )
        )
        medians = (
            quantile([getattr(c, gap) for c in changes], 0.5).value for gap in ("front_gap", "rear_gap")
        )
        headway = median_of_blocks(traffic.headways[name]).value
        cells = [name, "mixed" if traffic_name == MIXED else "own class", label, str(n)]
        cells += [rate(n, traffic.kilometres[name]).text(3), *shares]
        cells += [*("-" if math.isnan(gap) else f"{gap:.0f}" for gap in medians), f"{headway:.1f}"]
        lines.append(markdown_row(cells))
    collisions = sum(len(t.collisions) for t in {id(t): t for *_, t in rows}.values())
    vehicles = sum(t.vehicles for t in {id(t): t for *_, t in rows}.values())
    safety = f"{collisions} collisions among {vehicles:,} vehicles in all of these runs."
    return "\n".join(["", *lines, "", safety, ""])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.behaviors", description=(__doc__ or "").split("\n", 1)[0]
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--report", action="store_true", help="measure on test seeds, rewrite the tables")
    what.add_argument("--calibrate", action="store_true", help="fit LC2013 to MOBIL on validation seeds")
    parser.add_argument("--classes", nargs="+", choices=CLASSES, default=CLASSES, help="classes to fit")
    parser.add_argument(
        "--cache",
        type=Path,
        default=Path(tempfile.gettempdir()) / "cosim_behaviors_calibration.json",
        help="evaluations so far, to continue an interrupted fit; delete it after a change of the code",
    )
    parser.add_argument("--population", type=int, default=5, help="per parameter, of differential evolution")
    parser.add_argument("--generations", type=int, default=2)
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the report's simulated time")
    parser.add_argument("--out", type=Path, metavar="FILE.md", help="the page, with new tables (in place)")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build_highway(folder)
        if options.calibrate:
            calibrate(folder, options.classes, options.cache, options.population, options.generations)
            return
        tables = report(folder, options.scale)
    print(tables)
    out = options.out or (RESULTS if options.scale == 1.0 else None)
    if out is not None:
        before, rest = RESULTS.read_text(encoding="utf-8").split(BEGIN, 1)
        out.write_text(f"{before}{BEGIN}\n{tables}\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
