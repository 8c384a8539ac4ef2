"""Does yielding pay? The mentor drives every AV as an altruist and as an egoist, and is paid both times.

    python -m benchmarks.reward_balance [--seeds 150100:150106] [--scenario merge] [--out FILE]

The sum of all AVs' rewards of a whole `contested` episode at phi = 60 degrees, under several settings of
equation (6), same drives for all of them. A reward under which the altruist earns less cannot teach altruism,
however well it is learned. Tuning seeds; the mask guards both. `--out` writes the page.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.worlds import WITH_MISSION
from cosim.episode import Episode, Hook, Step, run_episode
from cosim.learning.configuration import configuration
from cosim.learning.rollouts import Rollout
from cosim.report import statistics
from cosim.rewards import RewardConfig, rewards
from cosim.seeding import generator
from cosim.workers.progress import Progress
from cosim.workers.worker import Worker
from policy.training.config import agent_config
from policy.training.curriculum import Lesson
from policy.training.explorer import Explorer

PHI = math.radians(60.0)
TRIED = {
    "P: 1/d, a mission vehicle counts 1": RewardConfig(mission=1.0),
    "1/d, mission 20": RewardConfig(),
    "1/d, mission 60": RewardConfig(mission=60.0),
    "1/d from 30 m on, mission 600": RewardConfig(mission=600.0, nearest=30.0),
    "no decay, 250 m, mission 20": RewardConfig(eta=0.0, mission=20.0, perception_range=250.0),
    "compact.yaml: no decay, 250 m, social 0.02, mission 150": configuration("compact").file.reward,
}


class Paid(Rollout):
    """Drives like a guided training episode and adds up what each setting pays."""

    def earn(self, world: str, seed: int, yields: bool) -> dict[str, Any]:
        """Sums by setting, and what became of the mission vehicle."""
        episode, paid = self.episode(Lesson(world, "contested")), Payments(self.agent)
        result = run_episode(episode, self.agent, seed, svo=PHI if yields else 0.0, hooks=[paid])
        return {"earned": paid.earned, "success": bool(result.value("mission_success"))}


class Payments(Hook):
    """What each setting pays all AVs together."""

    def __init__(self, agent: Explorer) -> None:
        self._agent = agent
        self.earned = dict.fromkeys(TRIED, 0.0)

    def on_start(self, episode: Episode) -> None:
        """The demonstrator drives."""
        self._agent.episode("balance", 0.0, generator(episode.seed, "explore"), True)

    def on_step(self, episode: Episode, step: Step) -> None:
        """One decision."""
        actions = {av: d.action for av, d in step.decisions.items()}
        for name, config in TRIED.items():
            terms = rewards(
                step.before, step.after, tuple(actions), actions, PHI, config, step.events.collisions
            )
            self.earned[name] += sum(t.total for t in terms.values())


def page(drives: dict[str, dict[bool, list[dict[str, Any]]]], command: str) -> str:
    """The table as Markdown: the altruist's gain, paired, as a share of what the egoist earns."""
    worlds = list(drives)
    count = len(next(iter(drives.values()))[True])
    lines = [
        "# Does yielding pay?",
        "",
        f"`{command}`: the mentor (docs/training.md) drives every AV of `contested`, as an altruist",
        f"and as an egoist, on the same {count} tuning seeds a world. What all AVs together earn at phi = 60",
        "degrees under several settings of equation (6): the altruist's gain over the egoist, mean of paired",
        "differences with bootstrap 95 % interval, as a share of what the egoist earns.",
        "",
        "| reward | " + " | ".join(worlds) + " |",
        "|---" * (len(worlds) + 1) + "|",
    ]
    for name in TRIED:
        cells = []
        for world in worlds:
            selfish, kind = (np.array([d["earned"][name] for d in drives[world][y]]) for y in (False, True))
            gain = statistics.mean(list(100.0 * (kind - selfish) / selfish.mean()))
            cells.append(f"{gain.text(0)} %")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    served = [
        " to ".join(str(sum(d["success"] for d in drives[world][y])) for y in (False, True)) + f" of {count}"
        for world in worlds
    ]
    lines.append("| *mission vehicles served, egoist to altruist* | " + " | ".join(served) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the page, or write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", default="150100:150120")
    parser.add_argument("--scenario", action="append", default=[])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    first, last = map(int, args.seeds.split(":"))
    worlds = args.scenario or WITH_MISSION
    file = configuration("compact").file
    agent = agent_config("vfn-p", file)
    progress, done = Progress("reward balance", "episodes"), 0
    drives: dict[str, dict[bool, list[dict[str, Any]]]] = {w: {False: [], True: []} for w in worlds}
    with Worker(Paid, "vfn-p", agent, file.explore, file.reward) as worker:
        for world in worlds:
            for seed in range(first, last):
                for yields in (False, True):
                    drives[world][yields].append(worker.call("earn", world, seed, yields))
                    done += 1
                    progress(done, 2 * (last - first) * len(worlds))
    progress.done()
    flags = "".join(f" --scenario {w}" for w in args.scenario)
    command = f"python -m benchmarks.reward_balance --seeds {args.seeds}{flags}"
    text = page(drives, command)
    if args.out:
        args.out.write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()
