"""Overhead of the engine of `cosim evaluate`, and speedup by a second worker.

    python -m benchmarks.batch [--policy vfn-p] [--duration 10] [--episodes 50] [--rounds 4]

By default 200 episodes of about one second of processor time each, on merge / dense.

Each round drives the same episodes with one worker and with two, in alternating order, so that other load
affects both. It includes all of `cosim evaluate`: processes, rows, store. Overhead is the time with one
worker, from the first row to the last, without the `total_s` that episodes measure inside their process.
`busy` is the share of time in which workers had an episode. Idle time is due to the engine, including start
and end; other losses are due to the machine.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from cosim.batch import execution as batch
from cosim.batch import matrix
from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.record import planned
from cosim.batch.store import Store
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import Progress

MAX_RATIO = 0.6  # target: time of two workers, as a share of the time of one
MAX_OVERHEAD = 0.05  # target: share of the serial time


@dataclass(frozen=True)
class Run:
    """One batch; times in s."""

    wall: float
    episodes: tuple[float, ...]  # total_s of each
    start: float  # until the first result, without that episode
    busy: float  # share of the workers' time
    between: float  # from the first result to the last


def measured(plan: matrix.Plan, workers: int, progress: Progress) -> Run:
    """Run the plan with a new store."""
    arrivals: list[float] = []

    def arrived(done: float, total: float) -> None:
        arrivals.append(time.perf_counter())
        progress(done, total)

    with tempfile.TemporaryDirectory() as folder, Store.in_folder(Path(folder)) as store:
        batch.begin(plan, store, {})
        began = time.perf_counter()
        batch.drive(plan, store, LocalEngine(EpisodeRunner, workers=workers), Path(folder), arrived)
        wall = time.perf_counter() - began
        rows = store.rows()
    if failed := [row for row in rows if row["status"] != "ok"]:
        raise SystemExit(f"{len(failed)} episodes failed: {failed[0]['error']}")
    episodes = tuple(row["total_s"] for row in rows)
    start = arrivals[0] - began - episodes[0]
    busy = sum(episodes) / (workers * (wall - start))
    return Run(wall, episodes, start, busy, arrivals[-1] - arrivals[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--policy", default="vfn-p")
    parser.add_argument("--duration", type=float, default=10.0)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--json", action="store_true", help="print only one document, at the end")
    args = parser.parse_args()
    seeds = range(200_000, 200_000 + args.episodes)
    plan = planned(seeds, scenario="merge", demand="dense", policy=args.policy, duration=args.duration)
    runs: dict[int, list[Run]] = {1: [], 2: []}
    for k in range(args.rounds):
        for workers in (1, 2) if k % 2 == 0 else (2, 1):
            progress = Progress(f"round {k + 1}, {workers} workers", "episodes")
            runs[workers].append(measured(plan, workers, progress))
            progress.done()
            last = runs[workers][-1]
            if args.json:
                continue
            print(
                f"round {k + 1}: {workers} workers, {args.episodes} episodes of "
                f"{statistics.median(last.episodes):.2f} s (median) in {last.wall:.1f} s, "
                f"start {last.start:.1f} s, busy {last.busy:.1%}",
                flush=True,
            )
    one, two = (sum(r.wall for r in runs[n]) for n in (1, 2))
    ratio = two / one
    overhead = sum(r.between for r in runs[1]) / sum(sum(r.episodes[1:]) for r in runs[1]) - 1.0
    if args.json:
        result = {
            "episodes": args.rounds * args.episodes,
            "episode_s": statistics.median(s for r in runs[1] for s in r.episodes),
            "one_worker_s": one,
            "two_workers_s": two,
            "ratio": ratio,
            "target": MAX_RATIO,
            "overhead": overhead,
            "overhead_target": MAX_OVERHEAD,
            "start_s": statistics.median(r.start for r in runs[1]),
        }
        print(json.dumps(result))
        return
    print(f"{args.rounds * args.episodes} episodes: {one:.0f} s with one worker, {two:.0f} s with two")
    print(f"two workers take {ratio:.2f} of the time of one (at most {MAX_RATIO})")
    print(f"the engine costs {overhead:.2%} of the serial time (at most {MAX_OVERHEAD:.0%})")


if __name__ == "__main__":
    main()
