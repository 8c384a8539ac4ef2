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

from cosim.app.progress import Progress
from cosim.app.runner import Runner
from cosim.evaluation import statistics
from cosim.scenario import load
from cosim.types import EpisodeResult
from cosim.worker import Worker

WORLDS = ("merge", "exit", "roundabout", "intersection", "highway")
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
    return f"{sum(hits)}/{len(hits)} = {statistics.share(sum(hits), len(hits)).text(0, 100.0)} %"


def mean(results: Sequence[EpisodeResult], name: str, digits: int = 0) -> str:
    """`mean (low to high)` of one figure, bootstrap 95 %."""
    return statistics.mean(figures(results, name)).text(digits)


def figures(results: Sequence[EpisodeResult], name: str) -> list[float]:
    """One figure of every episode; NA is nan."""
    values = [r.value(name) for r in results]
    return [math.nan if value is None else float(value) for value in values]


def table(world: str, demand: str, runs: dict[str, list[EpisodeResult]]) -> list[str]:
    """The Markdown table of one world."""
    first = next(iter(runs.values()))[0]
    has_mission = first.value("mission_success") is not None
    heads = ["policy", "mission success", "crashed", "AV-caused", "mission vehicle m", "AVs m", "all m"]
    heads += ["hard brakings of AVs", "not comparable"]
    lines = [
        f"## {world}, {demand}",
        "",
        f"Behaviour {first.behavior}, drivers {first.driver_model}, preset {first.preset}."
        + ("" if has_mission else " Nobody has a mission here, so nothing is claimed about one."),
        "",
        f"| {' | '.join(heads)} |",
        "|---" * len(heads) + "|",
    ]
    for policy, results in runs.items():
        cells = [
            policy,
            rate([bool(r.value("mission_success")) for r in results]) if has_mission else "-",
            rate([bool(r.value("crashed")) for r in results]),
            rate([bool(r.value("av_caused_collisions")) for r in results]),
            *(mean(results, name) for name in ("dt_mission_m", "dt_av_m", "dt_mean_m")),
            mean(results, "hard_brakings_av", 1),
            str(sum(bool(r.validity) for r in results)),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    if has_mission and {"idm", "altruist-rule"} <= runs.keys():
        before, after = (np.nanmean(figures(runs[p], "dt_mission_m")) for p in ("idm", "altruist-rule"))
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
