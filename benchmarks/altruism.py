"""Who is served when somebody yields: every policy on the contested demand of every world, paired seeds.

    python -m benchmarks.altruism [--seeds 200000:200040] [--scenario merge] [--policy idm] [--out FILE]

Writes docs/results/altruism.md (with --out) or prints it. Rates with Wilson 95 % intervals, means with
bootstrap 95 % intervals; the distance ratio is of means over equal seeds.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.intervals import share
from cosim.app.progress import Progress
from cosim.app.runner import Runner
from cosim.scenario import load
from cosim.types import EpisodeResult
from cosim.worker import Worker

WORLDS = ("merge", "exit", "roundabout", "intersection")
POLICIES = ("idm", "idm-courteous", "altruist-rule", "keep-lane")
COMMAND = "python -m benchmarks.altruism --seeds {seeds} --out docs/results/altruism.md"


def episodes(
    scenario: str, demand: str, policy: str, seeds: Sequence[int], progress: Progress | None = None
) -> list[EpisodeResult]:
    """One result per seed, all from one worker process."""
    with Worker(Runner, load(scenario, demand=[demand]), policy, math.pi / 4) as worker:
        results = []
        for k, seed in enumerate(seeds):
            results.append(worker.call("run", seed))
            if progress is not None:
                progress(k + 1, len(seeds))
        return results


def rate(hits: Sequence[bool]) -> str:
    """`k/n = p % (low to high)`, Wilson 95 %."""
    return f"{sum(hits)}/{len(hits)} = {share(sum(hits), len(hits)).text(0, 100.0)} %"


def mean(values: Sequence[float], digits: int = 0) -> str:
    """`mean (low to high)`, bootstrap 95 %."""
    data = np.array([v for v in values if v is not None], float)
    if len(data) < 2 or np.ptp(data) == 0:
        return f"{data.mean():.{digits}f}" if len(data) else "NA"
    rng = np.random.default_rng(0)
    low, high = stats.bootstrap((data,), np.mean, rng=rng, n_resamples=2000).confidence_interval
    return f"{data.mean():.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def table(world: str, demand: str, runs: dict[str, list[EpisodeResult]]) -> list[str]:
    """The Markdown table of one world."""
    first = next(iter(runs.values()))[0]
    lines = [
        f"## {world}, {demand}",
        "",
        f"Behaviour {first.behavior}, drivers {first.driver_model}, preset {first.preset}.",
        "",
        "| policy | mission success | crashed | AV-caused | mission vehicle m | AVs m | all m |"
        " hard brakings of AVs | not comparable |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for policy, results in runs.items():
        served = [bool(r.value("mission_success")) for r in results]
        crashed = [bool(r.value("crashed")) for r in results]
        caused = [bool(r.value("av_caused_collisions")) for r in results]
        figures = [
            mean([r.value(name) for r in results], digits)
            for name, digits in (
                ("dt_mission_m", 0),
                ("dt_av_m", 0),
                ("dt_mean_m", 0),
                ("hard_brakings_av", 1),
            )
        ]
        odd = sum(bool(r.validity) for r in results)
        cells = [policy, rate(served), rate(crashed), rate(caused), *figures, str(odd)]
        lines.append(f"| {' | '.join(cells)} |")
    if {"idm", "altruist-rule"} <= runs.keys() and first.value("dt_mission_m") is not None:
        before, after = (
            np.mean([r.value("dt_mission_m") for r in runs[p]]) for p in ("idm", "altruist-rule")
        )
        lines += ["", f"The mission vehicle travels {after / before:.2f} times as far with `altruist-rule`."]
    return [*lines, ""]


def main() -> None:
    """Run and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", default="200000:200040", metavar="A:B")
    parser.add_argument("--scenario", action="append")
    parser.add_argument("--policy", action="append")
    parser.add_argument("--demand", default="contested")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    first, last = map(int, args.seeds.split(":"))
    seeds = range(first, last)
    worlds, policies = args.scenario or WORLDS, args.policy or POLICIES
    jobs = [(w, p) for w in worlds for p in policies]
    progress = Progress("altruism", "runs")
    with ThreadPoolExecutor(args.workers) as pool:
        futures = {job: pool.submit(episodes, job[0], args.demand, job[1], seeds) for job in jobs}
        done = {}
        for k, (job, future) in enumerate(futures.items()):
            done[job] = future.result()
            progress(k + 1, len(jobs))
    progress.done()
    lines = [
        "# Who is served when somebody yields",
        "",
        f"Made by `{COMMAND.format(seeds=args.seeds)}`; {len(seeds)} episodes each, equal seeds.",
        "Rates with Wilson, means with bootstrap 95 % intervals.",
        "",
    ]
    for world in worlds:
        lines += table(world, args.demand, {p: done[world, p] for p in policies})
    text = "\n".join(lines)
    if args.out:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()
