"""Cost of sensing per AV and frame, by level, on the merge and in a city, on one thread.

    python -m benchmarks.sensing_cost [--levels ideal v2v ...] [--frames 100] [--small] [--out FILE.md]

SUMO drives all vehicles once; each level then perceives the same frames: sensors, messages, tracks, and the
percept of every AV. Processor time, which other load changes little; the minimum of `ROUNDS` rounds.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.decision_cost import WARM_UP, build_city
from benchmarks.tables import markdown_row, write_page
from cosim.road import RoadMap
from cosim.scenario import Fleet, Scenario, load
from cosim.scenario.sensing import IDEAL, levels, read
from cosim.scenario.vet import vetted
from cosim.seeding import TUNING_SEEDS
from cosim.sensing.perception import Perception
from cosim.simulation.sumo import SumoSimulator
from cosim.types import Preset, Snapshot, Timing

TARGET_US = {IDEAL: 20.0, "v2v": 100.0}  # per AV and frame
ROUNDS = 3
CITY_AVS = 50


class Drive(NamedTuple):
    """The frames of one drive."""

    name: str
    road: RoadMap
    timing: Timing
    frames: list[Snapshot]


def driven(name: str, scenario: Scenario, warm_up: float, frames: int) -> Drive:
    """`frames` frames after `warm_up` s, driven by SUMO."""
    simulator = SumoSimulator(scenario)
    try:
        found = list(simulator.reset(TUNING_SEEDS.start))
        while found[-1].time < warm_up:
            found = list(simulator.advance([])[1])
        while len(found) < frames:
            found += simulator.advance([])[1]
        return Drive(name, simulator.road, scenario.timing, found)
    finally:
        simulator.close()


def cost(drive: Drive, level: str) -> float:
    """Microseconds of processor time per AV and frame, the minimum of `ROUNDS`."""
    sensing = read(level)
    least = math.inf
    for _ in range(ROUNDS + 1):  # the first one compiles kernels
        began, many = time.thread_time(), 0
        perception = None
        if sensing is not None:
            perception = Perception(drive.road, sensing.parameters, drive.timing, TUNING_SEEDS.start)
        for frame in drive.frames:
            many += len(frame.avs)
            if perception is not None:
                for percept in perception.perceive(frame).values():
                    assert percept.world.n
        least = min(least, 1e6 * (time.thread_time() - began) / many)
    return least


def page(drives: Sequence[Drive], names: Sequence[str]) -> list[str]:
    """The Markdown page."""
    lines = [
        "# What sensing costs",
        "",
        "Made by `python -m benchmarks.sensing_cost --out docs/results/sensing_cost.md`.",
        "",
        "Microseconds of processor time per AV and frame, on one thread: sensors, messages, tracks and the",
        f"percept of every AV. Values are the minimum of {ROUNDS} rounds over the same frames.",
        "",
        markdown_row(["where", "AVs", "vehicles", *names]),
        markdown_row(["---"] * (3 + len(names))),
    ]
    for drive in drives:
        costs = [cost(drive, name) for name in names]
        known = [
            f"{value:.1f}" + (f" (at most {TARGET_US[name]:g})" if name in TARGET_US else "")
            for name, value in zip(names, costs, strict=True)
        ]
        last = drive.frames[-1]
        lines.append(markdown_row([drive.name, str(len(last.avs)), str(last.n), *known]))
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--levels", nargs="+", default=[IDEAL, *levels()])
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--small", action="store_true", help="few frames, only the merge")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(arguments)
    merge = load("merge", demand=["contested"], penetration=0.4, preset=Preset.UNGUARDED)
    drives = [driven("merge, contested", merge, 0.0, 20 if args.small else args.frames)]
    if not args.small:
        with tempfile.TemporaryDirectory() as folder:
            city = load(str(build_city(Path(folder), CITY_AVS)), fleet=Fleet(ids=r"av\..*"))
            drives.append(driven("city grid", vetted(city), WARM_UP, args.frames))
    write_page(args.out, page(drives, args.levels))


if __name__ == "__main__":
    main()
