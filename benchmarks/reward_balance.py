"""What ways of driving earn: does yielding pay, and does the way that is wanted earn most?

    python -m benchmarks.reward_balance [--seeds 150100:150106] [--scenario merge] [--out FILE]
    python -m benchmarks.reward_balance --ways [--seeds 150100:150106] [--scenario merge] [--out FILE]

The first page: the mentor drives every AV of `contested` as an altruist and as an egoist, and the sum of all
AVs' rewards of a whole episode at phi = 60 degrees is compared under several settings of equation (6). The
second: mean reward per AV and decision at phi = 45 degrees of crawling, holding lane and speed, IDM, the
scripted altruist and the learned agent. Same drives for all rewards, equal tuning seeds. A reward under which
the altruist earns less cannot teach altruism, however well it is learned. `--out` writes the page.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.papers.agents import Agent
from benchmarks.papers.driving import Order
from benchmarks.tables import markdown_row
from benchmarks.unled import Unled
from cosim.batch.case_runner import CaseRunner
from cosim.episode import Episode
from cosim.learning.configuration import configuration
from cosim.learning.prediction_data import spread
from cosim.report import statistics
from cosim.rewards import RewardConfig, rewards
from cosim.runner import Runner
from cosim.scenario.episode_id import Case
from cosim.types import Decision, Floats32, History, Kind, MetaAction, Policy, PolicyContext
from cosim.workers.engines import LocalEngine
from cosim.workers.tasks import Progress, Task
from policy.agents import make
from policy.agents.approaches import compact
from policy.agents.prediction_aware import Inputs
from policy.training.config import agent_config
from policy.training.explorer import Explorer

WORLDS = ("merge", "exit", "roundabout", "intersection")  # those with a mission vehicle
EVERY_WORLD = (*WORLDS, "highway")
DEMANDS = {"contested": "moderate", "dense": "mixed"}  # demand -> drivers
COMPACT = configuration("compact").file
TRIED = {
    "P: 1/d, a mission vehicle counts 1": RewardConfig(mission=1.0),
    "1/d, mission 20": RewardConfig(),
    "1/d, mission 60": RewardConfig(mission=60.0),
    "1/d from 30 m on, mission 600": RewardConfig(mission=600.0, nearest=30.0),
    "no decay, 250 m, mission 20": RewardConfig(eta=0.0, mission=20.0, perception_range=250.0),
    "compact.yaml: no decay, 250 m, social 0.02, mission 150": COMPACT.reward,
}
LEARNED = {
    "P's equation (6), defaults of `RewardConfig`: 1/d, mission 20": RewardConfig(),
    "T's equation (2), defaults: no decay, mission 20, own maneuvers cost": RewardConfig(variant="t"),
    "compact.yaml: no decay, 250 m, social 0.02, mission 150": COMPACT.reward,
}
MENTORED_PHI, PHI = 60.0, 45.0  # degrees at which drives are paid
WANTED, AGENT = "altruist-rule", "vfn-p"


class Mentored(Explorer):
    """The mentor drives every AV, guarded by the mask, as in a guided episode of the training."""

    def __init__(self) -> None:
        super().__init__("mentor", agent_config("vfn-p", COMPACT), COMPACT.explore)

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        super().reset(context)
        self.episode("balance", 0.0, context.rng, guided=True)


class Crawl(Unled):
    """Every AV at about `speed` m/s, guarded by the mask; it commands Accelerate or Decelerate to keep it."""

    def __init__(self, speed: float) -> None:
        super().__init__(f"crawl at {speed:g} m/s", compact("vfn-p"))
        self._speed = speed

    def values(self, inputs: Inputs) -> Floats32:
        """1 for what leads to the speed: a target on its other side while the AV is off it."""
        q = np.zeros((len(inputs.scene.agents), len(MetaAction)), np.float32)
        for row, history in zip(q, inputs.scene.histories, strict=True):
            fast, high = history.ego_speed > self._speed, history.target_speed > self._speed
            wanted = MetaAction.IDLE
            if fast == high:
                wanted = MetaAction.DECELERATE if fast else MetaAction.ACCELERATE
            row[wanted] = 1.0
        return q


WAYS: dict[str, Callable[[], Policy]] = {
    "crawl at 8 m/s": partial(Crawl, 8.0),
    "crawl at 14 m/s": partial(Crawl, 14.0),
    **{name: partial(make, name) for name in ("keep-lane", "idm", WANTED, AGENT)},
}


class PaidEpisode(Episode):
    """An episode that adds up what several rewards pay all AVs."""

    def pay_by(self, settings: Mapping[str, RewardConfig], phi: float) -> None:
        """From the next start on; phi in rad."""
        self._settings, self._phi = settings, phi

    def start(self, seed: int) -> dict[str, History]:
        """As `Episode.start`."""
        self.earned, self.paid = dict.fromkeys(self._settings, 0.0), 0
        return super().start(seed)

    def advance(self, decisions: Mapping[str, Decision]) -> dict[str, History]:
        """As `Episode.advance`."""
        before = self.snapshot
        histories = super().advance(decisions)
        avs = [name for name, kind in zip(before.ids, before.kind, strict=True) if kind == Kind.AV]
        actions = {av: decision.action for av, decision in decisions.items()}
        for name, config in self._settings.items():
            terms = rewards(before, self.snapshot, avs, actions, self._phi, config, self.events.collisions)
            self.earned[name] += sum(t.total for t in terms.values())
        self.paid += len(avs)
        return histories


class Paid(CaseRunner):
    """Drives the AVs of a case in one of WAYS, or as the mentor does, and adds up what each reward pays."""

    def policy(self, case: Case) -> Policy:
        """One of WAYS, or the mentor."""
        return WAYS[case.policy]() if case.policy in WAYS else Mentored()

    def open(self, case: Case, warnings: tuple[str, ...]) -> Runner:
        """The case's runner with an episode that pays."""
        runner = super().open(case, warnings)
        if not isinstance(runner._episode, PaidEpisode):
            plain = runner._episode
            runner._episode = PaidEpisode(plain.scenario, plain.simulator, plain.observation)
        return runner

    def run(self, case: Case, settings: Any, phi_deg: Any, progress: Progress) -> dict[str, Any]:
        """`earned`: sums over all AVs and decisions; `each`: the same per AV and decision that was planned,
        those after a crash having earned nothing."""
        episode = self.open(case, ())._episode
        assert isinstance(episode, PaidEpisode)
        episode.pay_by(settings, math.radians(phi_deg))
        document = super().run(case, (), None, progress)
        planned = round(episode.scenario.duration / episode.scenario.timing.decision)
        share = planned * episode.paid / max(document["steps"], 1)
        each = {name: earned / max(share, 1.0) for name, earned in episode.earned.items()}
        return document | {"earned": episode.earned, "each": each}


def driven(
    cases: Sequence[Case], settings: Mapping[str, RewardConfig], phi: float, workers: int
) -> list[dict[str, Any]]:
    """What `Paid.run` returned for each case."""
    tasks = [Task(case.key, case.cell, (case, settings, phi)) for case in cases]
    return spread(LocalEngine(Paid, workers=workers), tasks, "rewards")


def case_of(policy: str, world: str, demand: str, svo_deg: float) -> Case:
    """Any seed of it."""
    return Order(Agent(policy), world, demand, DEMANDS[demand], 1, svo_deg).case


def balance(worlds: Sequence[str], seeds: range, command: str, workers: int) -> list[str]:
    """The altruist's gain, paired, as a share of what the egoist earns."""
    cells = [case_of("mentor", world, "contested", phi) for world in worlds for phi in (0.0, MENTORED_PHI)]
    found = driven([c.with_seed(s) for c in cells for s in seeds], TRIED, MENTORED_PHI, workers)
    drives: dict[str, dict[bool, list[dict[str, Any]]]] = {w: {False: [], True: []} for w in worlds}
    for drive in found:
        drives[drive["scenario"]][drive["svo_deg"] > 0.0].append(drive)
    lines = [
        "# Does yielding pay?",
        "",
        f"`{command}`: the mentor (docs/training.md) drives every AV of `contested`, as an altruist",
        f"and as an egoist, on the same {len(seeds)} tuning seeds a world. "
        "What all AVs together earn at phi = 60",
        "degrees under several settings of equation (6): the altruist's gain over the egoist, mean of paired",
        "differences with bootstrap 95 % interval, as a share of what the egoist earns.",
        "",
        "| reward | " + " | ".join(worlds) + " |",
        "|---" * (len(worlds) + 1) + "|",
    ]
    for name in TRIED:
        shares = []
        for world in worlds:
            selfish, kind = (np.array([d["earned"][name] for d in drives[world][y]]) for y in (False, True))
            gain = statistics.mean(list(100.0 * (kind - selfish) / selfish.mean()))
            shares.append(f"{gain.text(0)} %")
        lines.append(f"| {name} | " + " | ".join(shares) + " |")
    served = [
        " to ".join(str(sum(bool(d["mission_success"]) for d in drives[world][y])) for y in (False, True))
        + f" of {len(seeds)}"
        for world in worlds
    ]
    return [*lines, "| *mission vehicles served, egoist to altruist* | " + " | ".join(served) + " |"]


def by_way(worlds: Sequence[str], seeds: range, command: str, workers: int) -> list[str]:
    """Mean reward of every way of driving under every reward, and whether the wanted way earns most."""
    keys = list(itertools.product(WAYS, worlds, DEMANDS))
    cases = [case_of(*key, PHI).with_seed(seed) for key in keys for seed in seeds]
    found = driven(cases, LEARNED, PHI, workers)
    drives = {key: found[k * len(seeds) : (k + 1) * len(seeds)] for k, key in enumerate(keys)}
    lines = [
        "# What each way of driving earns under each reward",
        "",
        f"`{command}`: all AVs drive one way, on the same {len(seeds)} tuning seeds a world and",
        "demand, `contested` among moderate and `dense` among mixed drivers (`lc2013`, preset `unguarded`).",
        "Mean reward per AV and decision at phi 45 degrees with bootstrap 95 % interval over episodes; the",
        "decisions that a crash leaves undriven have earned nothing. Crawling is guarded by the safety",
        "prioritizer, `keep-lane` by nobody; `idm`, and `altruist-rule` where it commands nothing, are "
        "driven",
        "by SUMO, so that their maneuvers cost nothing under T's reward. The way that is wanted in "
        "`contested`",
        f"is `{WANTED}`: the last line of each table says whether it earns more than the best of the other",
        "scripted ways (by mean), and how much, paired.",
        "",
    ]
    for demand, (reward, title) in itertools.product(DEMANDS, enumerate(LEARNED)):
        lines += [f"## {demand}", ""] if reward == 0 else []
        lines += [f"**{title}**", "", markdown_row(["", *worlds]), "|---" * (len(worlds) + 1) + "|"]
        each = {
            (way, world): np.array([d["each"][title] for d in drives[way, world, demand]])
            for way in WAYS
            for world in worlds
        }
        for way in WAYS:
            lines.append(markdown_row([way, *(statistics.mean(each[way, w]).text(2) for w in worlds)]))
        verdicts = []
        for world in worlds:
            others = [way for way in WAYS if way not in (WANTED, AGENT)]
            best = max(others, key=lambda way: float(each[way, world].mean()))
            gain = statistics.paired_mean(each[best, world], each[WANTED, world])
            said = "yes" if gain.low > 0.0 else "no" if gain.high < 0.0 else "undecided"
            verdicts.append(f"{said}: {gain.text(2)} on {best}")
        lines += [markdown_row([f"*{WANTED} earns most?*", *verdicts]), ""]
    lines += ["## What became of them", "", "Mission vehicles served, episodes with a crash:", ""]
    for demand in DEMANDS:
        lines += [markdown_row([demand, *worlds]), "|---" * (len(worlds) + 1) + "|"]
        for way in WAYS:
            cells_of_way = []
            for world in worlds:
                mine = drives[way, world, demand]
                known = [d["mission_success"] for d in mine if d["mission_success"] is not None]
                served = f"{sum(known)}/{len(known)} served" if known else "no mission"
                cells_of_way.append(f"{served}, {sum(d['crashed'] for d in mine)} crashed")
            lines.append(markdown_row([way, *cells_of_way]))
        lines.append("")
    return lines


def main() -> None:
    """Print the page, or write it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reward_balance", description=__doc__)
    parser.add_argument("--ways", action="store_true", help="what each way of driving earns")
    parser.add_argument("--seeds", metavar="A:B", help="default 150100:150120; --ways: 150100:150106")
    parser.add_argument("--scenario", action="append", default=[])
    parser.add_argument("--workers", type=int, default=1, metavar="N")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    seeds = args.seeds or ("150100:150106" if args.ways else "150100:150120")
    worlds = args.scenario or list(EVERY_WORLD if args.ways else WORLDS)
    flags = "".join(f" --scenario {w}" for w in args.scenario)
    command = f"python -m benchmarks.reward_balance{' --ways' if args.ways else ''} --seeds {seeds}{flags}"
    make_page = by_way if args.ways else balance
    text = "\n".join(make_page(worlds, range(*map(int, seeds.split(":"))), command, args.workers)).rstrip()
    if args.out:
        args.out.write_text(text + "\n")
    else:
        print(text)


if __name__ == "__main__":
    main()
