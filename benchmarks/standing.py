"""Number of vehicles on a network that stand for long without a reason, and the resulting delays.

    python -m benchmarks.standing CONFIG [--av-type NAME | --penetration P] [--policies NAME ...]
                                  [--seeds A:B] [--duration S] [--warmup S]

Drives CONFIG (a .sumocfg) in preset `lawful` and prints a row per policy: means over the seeds, with the
number of vehicles (AVs and HVs) that stood (below 0.1 m/s) for `LONG` s without a red light ahead, a <stop>
or a crash. `car-alone` is the lawful car with an agent that always accelerates; `none` has no AVs, in the
same traffic.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from statistics import fmean
from typing import Any

from benchmarks.tables import markdown_row
from cosim.cli.arguments import seeds as seed_range
from cosim.episode import Episode, Hook, Step
from cosim.host import Host
from cosim.metrics.standing import CLOSED, STANDSTILL
from cosim.scenario import Fleet, Scenario, load
from cosim.scenario.vet import vetted
from cosim.types import EpisodeResult, Kind, Preset
from cosim.workers.worker import Worker

LONG = 120.0  # s
SIGNALS = frozenset(map(chr, CLOSED))
CAR, NONE = "car-alone", "none"
POLICIES = (NONE, "idm", "idm-courteous", CAR)
FIGURES = {
    "arrivals": "arrivals",
    "AV trips": "av_trips_completed",
    "delay, s": "total_delay_s",
    "AVs stuck": "avs_stuck",
    "collisions": "collisions",
    "with an AV": "av_involved_collisions",
    "red lights": "red_light_violations",
    "right of way": "right_of_way_violations",
    "AV near-misses (TTC)": "av_near_misses_ttc",
    "(PET)": "av_near_misses_pet",
    "AV-km": "av_km",
}


class LongStands(Hook):
    """The longest standstill (s) of each vehicle without a reason."""

    def on_start(self, episode: Episode) -> None:
        self._since: dict[str, float] = {}
        self._wrecks: set[str] = set()
        self.longest: dict[str, float] = {}

    def on_step(self, episode: Episode, step: Step) -> None:
        from cosim.simulation.backend import sumo  # libsumo, only in the worker process

        frame = step.after
        self._wrecks.update(step.events.wrecked)
        excused = self._wrecks.union(frame.events.stopped)
        since: dict[str, float] = {}
        for row, name in enumerate(frame.ids):
            if frame.speed[row] >= STANDSTILL or frame.kind[row] == Kind.PERSON:
                continue
            lights = sumo.vehicle.getNextTLS(name)
            waits = name in excused or (bool(lights) and lights[0][3] in SIGNALS)
            since[name] = frame.time if waits else self._since.get(name, frame.time)
            self.longest[name] = max(self.longest.get(name, 0.0), frame.time - since[name])
        self._since = since


class Watcher(Host):
    """A host that also returns the longest standstill of each vehicle."""

    def watched(self, seed: int) -> tuple[EpisodeResult, dict[str, float]]:
        """Drive one episode."""
        stands = LongStands()
        return self.run(seed, hooks=[stands]), stands.longest


def drive(scenario: Scenario, policy: str, seeds: range) -> dict[str, float]:
    """Means over the seeds."""
    rows: list[dict[str, Any]] = []
    agent = "idm" if policy == NONE else policy
    with Worker(Watcher, scenario, agent, math.pi / 4) as worker:
        for seed in seeds:
            result, longest = worker.call("watched", seed)
            found = {title: result.value(name) for title, name in FIGURES.items()}
            long = sum(stood >= LONG for stood in longest.values())
            rows.append(
                {**found, f"stood {LONG:g} s": long, "longest, s": max(longest.values(), default=0.0)}
            )
            print(policy, seed, rows[-1], flush=True)
    return {title: fmean(float(row[title] or 0.0) for row in rows) for title in rows[0]}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config")
    parser.add_argument("--av-type")
    parser.add_argument("--penetration", type=float)
    parser.add_argument("--policies", nargs="+", default=POLICIES)
    parser.add_argument("--seeds", type=seed_range, default="140000:140003")
    parser.add_argument("--duration", type=float)
    parser.add_argument("--warmup", type=float)
    given = parser.parse_args(arguments)
    found = {}
    for policy in given.policies:
        fleet = Fleet(penetration=0.0) if policy == NONE else Fleet(given.av_type, None, given.penetration)
        scenario = load(
            given.config, preset=Preset.LAWFUL, fleet=fleet, duration=given.duration, warmup=given.warmup,
            mission="none", traffic="controlled",
        )  # fmt: skip
        found[policy] = drive(vetted(scenario), policy, given.seeds)
    titles = list(next(iter(found.values())))
    print(markdown_row(["AVs", *titles]), markdown_row(["---"] * (len(titles) + 1)), sep="\n")
    for policy, row in found.items():
        print(markdown_row([policy, *(f"{row[title]:.2f}" for title in titles)]))


if __name__ == "__main__":
    main()
