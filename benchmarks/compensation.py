"""Errors of delayed states that are predicted to the present, by compensation and delay.

    python -m benchmarks.compensation [--seeds A:B] [--small] [--out FILE.md]

`altruist-rule` drives the AVs once per scenario and seed; each compensation then perceives the same frames.
The error is the distance between the perceived and the true position of a human-driven vehicle. In the first
rows own sensors see all vehicles late but without noise; the last rows use the level `v2v`.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np

from benchmarks.tables import markdown_row, write_page
from cosim.arrays import Floats
from cosim.cli.arguments import seeds
from cosim.episode import Episode, Hook, Step
from cosim.host import Host
from cosim.policies import compensator
from cosim.road import RoadMap
from cosim.scenario import load
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.sensing import Parameters, levels
from cosim.sensing.perception import PREDICTED, Perception
from cosim.types import Compensator, Kind, Preset, Snapshot, Timing, Tracks

SCENARIOS = ("merge", "roundabout", "intersection")
POLICY = "altruist-rule"
DELAYS = (0.4, 0.8, 1.6)  # s
COMPENSATIONS: tuple[Any, ...] = tuple(
    how for how in get_args(get_type_hints(Parameters)["compensation"]) if how != "truth"
)
LATE = "{delay:g} s late"
SKIPPED = 20  # frames, until the AV's histories are full
EVERY = 5  # frames, once a second
PERCEIVING = 1  # AVs per episode, longest on the road; without noise all AVs perceive the same
DURATION, SMALL = 24.0, 8.0  # s
DRAWS, BOOTSTRAP_SEED = 1000, 1


class Drive(NamedTuple):
    """The frames of one episode; only `PERCEIVING` of its AVs perceive."""

    seed: int
    road: RoadMap
    timing: Timing
    frames: list[Snapshot]
    humans: frozenset[str]


class SampledCompensator:
    """A `cosim.types.Compensator` that calls another one only while `sampling`, to save time."""

    sampling = False

    def __init__(self, compensator: Compensator) -> None:
        self._compensator, self.frames = compensator, compensator.frames

    def present(self, tracks: Tracks) -> Floats:
        return self._compensator.present(tracks) if self.sampling else tracks.state[:, -1]


class Frames(Hook):
    """Keeps every frame of an episode."""

    def on_start(self, episode: Episode) -> None:
        self.kept = list(episode.frames)

    def on_step(self, episode: Episode, step: Step) -> None:
        self.kept += step.frames


def driven(scenario: str, numbers: Sequence[int], duration: float) -> list[Drive]:
    """The episodes of the seeds `numbers` in one scenario, mixed and contested."""
    options = EpisodeOptions(
        scenario,
        demand=("contested",),
        behavior="mixed",
        penetration=0.4,
        preset=Preset.UNGUARDED,
        duration=duration,
    )
    found = load(options)
    host = Host(found, POLICY, math.radians(45.0))
    drives = []
    try:
        for seed in numbers:
            hook = Frames()
            host.run(seed, hooks=[hook])
            humans = frozenset(f.ids[k] for f in hook.kept for k in np.flatnonzero(f.kind == Kind.HV))
            stays = Counter(av for frame in hook.kept for av in frame.avs).most_common(PERCEIVING)
            frames = [_with_avs(frame, {av for av, _ in stays}) for frame in hook.kept]
            drives.append(Drive(seed, host.simulator.road, found.timing, frames, humans))
    finally:
        host.close()
    return drives


def _with_avs(frame: Snapshot, avs: set[str]) -> Snapshot:
    """The frame with only `avs` as AVs."""
    kind = frame.kind.copy()
    kind[[frame.row[name] for name in frame.avs if name not in avs]] = Kind.HV
    return replace(frame, kind=kind)


def errors(drive: Drive, level: Parameters) -> Floats:
    """[k,2] m and m/s, errors of position and speed of human-driven vehicles, once a second."""
    how = level.compensation
    made = SampledCompensator(compensator(how, drive.road, drive.timing)) if how in PREDICTED else None
    perception = Perception(drive.road, level, drive.timing, drive.seed, made)
    found = []
    for k, frame in enumerate(drive.frames):
        sampled = k >= SKIPPED and k % EVERY == 0
        if made is not None:
            made.sampling = sampled
        percepts = perception.perceive(frame)
        if not sampled:
            continue
        for percept in percepts.values():
            world = percept.world
            rows = [(r, frame.row[i]) for i, r in world.row.items() if i in drive.humans and i in frame.row]
            seen, real = np.array(rows, np.int64).reshape(-1, 2).T
            distance = np.hypot(world.x[seen] - frame.x[real], world.y[seen] - frame.y[real])
            found.append(np.stack([distance, np.abs(world.speed[seen] - frame.speed[real])], 1))
    return np.concatenate(found) if found else np.zeros((0, 2))


def conditions() -> Iterator[tuple[str, Parameters]]:
    """Name and level of every row."""
    for delay in DELAYS:
        yield LATE.format(delay=delay), Parameters(latency=delay)
    yield "`v2v`", levels()["v2v"]
    yield "`v2v,delay=0.8,range=1`", replace(levels()["v2v"], delay=0.8, range=1.0, equipped=1.0)


def interval(means: Floats) -> str:
    """Mean and 95 % interval over episodes (bootstrap)."""
    drawn = np.random.default_rng(BOOTSTRAP_SEED).integers(0, len(means), (DRAWS, len(means)))
    low, high = np.quantile(means[drawn].mean(1), (0.025, 0.975))
    return f"{means.mean():.3f} ({low:.3f} to {high:.3f})"


def table(drives: Sequence[Drive]) -> list[str]:
    """The tables of one scenario: mean distance and 99th percentile."""
    head = [markdown_row(["sensing", *COMPENSATIONS]), markdown_row(["---"] * (1 + len(COMPENSATIONS)))]
    means, tails = list(head), list(head)
    for name, level in conditions():
        each = [
            [errors(drive, replace(level, compensation=how)) for drive in drives] for how in COMPENSATIONS
        ]
        means.append(markdown_row([name, *(interval(np.array([e[:, 0].mean() for e in es])) for es in each)]))
        parts = [np.quantile(np.concatenate(es), 0.99, axis=0) for es in each]
        tails.append(markdown_row([name, *(f"{m:.2f}, {v:.2f}" for m, v in parts)]))
    return ["Mean distance, m:", "", *means, "", "99th percentile, m and m/s:", "", *tails]


def page(numbers: Sequence[int], duration: float, scenarios: Sequence[str]) -> list[str]:
    """The Markdown page."""
    lines = [
        "# Errors of delayed positions with latency compensation",
        "",
        f"Made by `python -m benchmarks.compensation --seeds {numbers[0]}:{numbers[-1] + 1}`.",
        "",
        "The distance between the perceived and the true position of a human-driven vehicle, by the",
        "`compensation` of the AV's [sensing](../reference/sensing.md). Demand contested, behavior mixed,",
        f"40 % AVs. `{POLICY}` drives {len(numbers)} episodes of {duration:g} s per scenario. All",
        "compensations get the same frames, and one AV perceives. Intervals are 95 %, over episodes.",
        "",
        "In the first rows the AV's own sensors see all vehicles, late and without noise. `v2v` has noise,",
        "losses and a line of sight. The last row has messages only, and all vehicles are equipped.",
    ]
    for scenario in scenarios:
        lines += ["", f"## {scenario}", "", *table(driven(scenario, numbers, duration))]
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=seeds, default=range(100_000, 100_003))
    parser.add_argument("--small", action="store_true", help="one short episode, only the merge")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(arguments)
    numbers, duration = (args.seeds[:1], SMALL) if args.small else (args.seeds, DURATION)
    write_page(args.out, page(numbers, duration, SCENARIOS[:1] if args.small else SCENARIOS))


if __name__ == "__main__":
    main()
