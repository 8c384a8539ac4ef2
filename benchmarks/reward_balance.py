"""What ways of driving earn: does yielding pay, and does the way that is wanted earn most?

    python -m benchmarks.reward_balance [--seeds 150100:150106] [--scenario merge] [--out FILE]
    python -m benchmarks.reward_balance --ways [--seeds 150100:150106] [--scenario merge] [--out FILE]

The first page: the demonstrator drives every AV of `contested` as an altruist and as an egoist, and the sum
of all AVs' rewards of a whole episode at phi = 60 degrees is compared under several settings of equation
(6). The second: mean reward per AV and decision at phi = 45 degrees of crawling, holding lane and speed, IDM,
the scripted altruist and the learned agent. Same drives for all rewards, equal tuning seeds. A reward under
which the altruist earns less cannot teach altruism, however well it is learned. `--out` writes the page.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.papers.agents import Agent
from benchmarks.papers.driving import Order
from benchmarks.tables import markdown_row
from benchmarks.unled import Unled
from benchmarks.worlds import WITH_MISSION, WORLDS
from cosim.batch.episode_runner import EpisodeRunner
from cosim.host import Earnings
from cosim.learning.configuration import configuration
from cosim.learning.prediction_data import spread
from cosim.report import statistics
from cosim.rewards import RewardConfig
from cosim.scenario.episode_id import EpisodeId
from cosim.types import Floats32, MetaAction, Policy, PolicyContext, Preset
from cosim.workers.engines import LocalEngine
from cosim.workers.tasks import Progress, Task
from policy.agents import make
from policy.agents.approaches import compact
from policy.agents.prediction_aware import Inputs
from policy.training.config import agent_config
from policy.training.explorer import Explorer

DEMANDS = {"contested": "moderate", "dense": "mixed"}  # demand -> drivers
COMPACT, REWARDS = (configuration(name).file for name in ("compact", "rewards"))
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
    f"rewards.yaml: the same, mission {REWARDS.reward.mission:g}": REWARDS.reward,
}
DEMONSTRATED_PHI, PHI = 60.0, 45.0  # degrees at which drives are paid
WANTED, AGENT = "altruist-rule", "vfn-p-demonstrated"


class Demonstrated(Explorer):
    """The demonstrator drives every AV, guarded by the mask, as in a guided episode of the training."""

    def __init__(self) -> None:
        super().__init__("demonstrator", agent_config(AGENT, COMPACT), COMPACT.explore)

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        super().reset(context)
        self.episode("balance", 0.0, context.rng, context.rng, guided=True)


class Crawl(Unled):
    """Every AV at about `speed` m/s, guarded by the mask; it commands Accelerate or Decelerate to keep it."""

    def __init__(self, speed: float) -> None:
        super().__init__(f"crawl at {speed:g} m/s", compact(AGENT))
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


class Paid(EpisodeRunner):
    """Drives the AVs of a case in one of WAYS, or as the demonstrator does, and adds up what rewards pay."""

    def policy(self, case: EpisodeId) -> Policy:
        """One of WAYS, or the demonstrator."""
        return WAYS[case.policy]() if case.policy in WAYS else Demonstrated()

    def run(  # type: ignore[override]
        self, case: EpisodeId, settings: Mapping[str, RewardConfig], phi: float, progress: Progress
    ) -> dict[str, Any]:
        """`earned`: sums over all AVs and decisions, paid at `phi` degrees; `each`: the same per AV and
        decision that was planned, those after a crash having earned nothing."""
        host = self.open(case, ())
        hooks = {name: Earnings(config, math.radians(phi)) for name, config in settings.items()}
        result = host.run(case.seed, progress, hooks=list(hooks.values()))
        scenario = host.episode.scenario
        planned = round(scenario.duration / scenario.timing.decision)
        paid = len(next(iter(hooks.values())).totals)  # decisions of single AVs
        share = max(planned * paid / max(result.steps, 1), 1.0)
        earned = {name: sum(hook.totals) for name, hook in hooks.items()}
        each = {name: total / share for name, total in earned.items()}
        return result.document() | {"earned": earned, "each": each}


def driven(
    cases: Sequence[EpisodeId], settings: Mapping[str, RewardConfig], phi: float, workers: int
) -> list[dict[str, Any]]:
    """What `Paid.run` returned for each case."""
    tasks = [Task(case.key, case.cell, (case, settings, phi)) for case in cases]
    return spread(LocalEngine(Paid, workers=workers), tasks, "rewards")


def case_of(policy: str, world: str, demand: str, svo_deg: float, duration: float | None) -> EpisodeId:
    """Any seed of it; `duration`: counted s, None: the world's own."""
    return replace(Order(Agent(policy), world, demand, DEMANDS[demand], 1, svo_deg).case, duration=duration)


def balance(
    worlds: Sequence[str], seeds: range, command: str, workers: int, duration: float | None
) -> list[str]:
    """The altruist's gain, paired, as a share of what the egoist earns."""
    cells = [
        case_of("demonstrator", world, "contested", phi, duration)
        for world in worlds
        for phi in (0.0, DEMONSTRATED_PHI)
    ]
    found = driven([c.with_seed(s) for c in cells for s in seeds], TRIED, DEMONSTRATED_PHI, workers)
    drives: dict[str, dict[bool, list[dict[str, Any]]]] = {w: {False: [], True: []} for w in worlds}
    for drive in found:
        drives[drive["scenario"]][drive["svo_deg"] > 0.0].append(drive)
    lines = [
        "# Does yielding pay?",
        "",
        f"`{command}`: the demonstrator (docs/training.md) drives every AV of `contested`, as an altruist",
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


def by_way(
    worlds: Sequence[str], seeds: range, command: str, workers: int, duration: float | None
) -> list[str]:
    """Mean reward of every way of driving under every reward, and whether the wanted way earns most."""
    keys = list(itertools.product(WAYS, worlds, DEMANDS))
    cells = [replace(case_of(*key, PHI, duration), preset=Preset.LAWFUL) for key in keys]
    cases = [cell.with_seed(seed) for cell in cells for seed in seeds]
    found = driven(cases, LEARNED, PHI, workers)
    drives = {key: found[k * len(seeds) : (k + 1) * len(seeds)] for k, key in enumerate(keys)}
    lines = [
        "# What each way of driving earns under each reward",
        "",
        f"`{command}`:",
        f"all AVs drive one way, on the same {len(seeds)} tuning seeds a world and demand, `contested` among",
        "moderate and `dense` among mixed drivers (`lc2013`, preset `lawful`). Mean reward per AV and",
        "decision at phi 45 degrees with bootstrap 95 % interval over episodes; the decisions that a crash",
        "leaves undriven have earned nothing. `keep-lane` is `unguarded` always; `idm`, and `altruist-rule`",
        "where it commands nothing, are driven by SUMO: their maneuvers cost nothing under T's reward.",
        f"The way that is wanted in `contested` is `{WANTED}`: the last line of each table says whether it",
        "earns more than the best of the other scripted ways (by mean), and how much, paired.",
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
    parser.add_argument("--duration", type=float, metavar="S", help="counted s an episode; the worlds' own")
    parser.add_argument("--workers", type=int, default=1, metavar="N")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    seeds = args.seeds or ("150100:150106" if args.ways else "150100:150120")
    worlds = args.scenario or list(WORLDS if args.ways else WITH_MISSION)
    flags = "".join(f" --scenario {w}" for w in args.scenario)
    flags += "" if args.duration is None else f" --duration {args.duration:g}"
    command = f"python -m benchmarks.reward_balance{' --ways' if args.ways else ''} --seeds {seeds}{flags}"
    make_page = by_way if args.ways else balance
    wanted = range(*map(int, seeds.split(":")))
    text = "\n".join(make_page(worlds, wanted, command, args.workers, args.duration)).rstrip()
    if args.out:
        args.out.write_text(text + "\n")
    else:
        print(text)


if __name__ == "__main__":
    main()
