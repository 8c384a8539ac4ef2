"""Does it pay one AV to drive slower than it could? A reward that counts who is near may say so.

    python -m benchmarks.falling_back [--seeds 150100:150106] [--out docs/results/falling_back.md]

All AVs drive by `altruist-rule`, and again on the same seed with one of them at 60 % of its first speed, if
nothing is in its way. What that one earns per decision at phi 60 degrees, under rewards that count who is
within 250 m, and all vehicles: where an AV is slow, it stays beside a mission vehicle for longer, and is paid
for how fast that one drives. The clearer falling back costs, the sooner it is unlearned.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reward_balance import REWARDS, case_of
from benchmarks.tables import markdown_row, write_page
from benchmarks.worlds import WITH_MISSION
from cosim.batch.episode_runner import EpisodeRunner
from cosim.cli.arguments import seeds as seeds_of
from cosim.episode import Episode, Step
from cosim.host import Earnings
from cosim.learning.prediction_data import spread
from cosim.report.statistics import mean, paired_mean
from cosim.rewards import RewardConfig
from cosim.scenario.episode_id import EpisodeId
from cosim.types import Decision, History, MetaAction, PolicyContext, Preset
from cosim.workers.engines import LocalEngine
from cosim.workers.tasks import Progress, Task
from policy.agents.altruist_rule import AltruistRule

PAGE = Path("docs/results/falling_back.md")
PHI, SLOW = 60.0, 0.6  # degrees; of the first speed
RANGES = (250.0, 3000.0)  # m
MISSIONS = (50.0, 100.0, 200.0)
SETTINGS: dict[str, RewardConfig] = {
    f"{'all vehicles' if far > 1000 else f'within {far:g} m'}, mission {mission:g}": replace(
        REWARDS.reward, perception_range=far, mission=mission
    )
    for mission in MISSIONS
    for far in RANGES
}


class OneSlower(AltruistRule):
    """`altruist-rule`, but for one AV, if any: `who`-th of those that are there first, by name."""

    def __init__(self, who: int, slow: bool) -> None:
        self._who, self._slow = who, slow
        self.chosen = ""

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        super().reset(context)
        self.chosen, self._wanted = "", 0.0

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """The rule's, and the slow one's."""
        decisions = super().decide(histories)
        if not self.chosen and histories:
            self.chosen = sorted(histories)[self._who % len(histories)]
            self._wanted = SLOW * histories[self.chosen].ego_speed
        if self._slow and self.chosen in histories:
            slower = histories[self.chosen].target_speed > self._wanted
            decisions[self.chosen] = Decision(MetaAction.DECELERATE if slower else MetaAction.IDLE)
        return decisions


class OfOne(Earnings):
    """What the chosen AV earns."""

    def __init__(self, policy: OneSlower, reward: RewardConfig) -> None:
        super().__init__(reward, math.radians(PHI))
        self._policy = policy

    def on_step(self, episode: Episode, step: Step) -> None:
        """One decision, while it is on the road."""
        if (who := self._policy.chosen) in step.before.vehicles.row:
            self.totals.append(self.pay(step, step.before.avs)[who].total)


class Earning(EpisodeRunner):
    """Hosted by an engine's worker."""

    def policy(self, case: EpisodeId) -> OneSlower:
        """Who is asked for in the policy's place: 'INDEX slow' or 'INDEX'."""
        who, *slow = case.policy.split()
        self._made = OneSlower(int(who), bool(slow))
        return self._made

    def run(self, case: EpisodeId, progress: Progress) -> dict[str, Any]:  # type: ignore[override]
        """Mean reward per decision under each of SETTINGS, and the row."""
        host = self.open(case, ())
        hooks = {name: OfOne(self._made, reward) for name, reward in SETTINGS.items()}
        result = host.run(case.seed, progress, hooks=list(hooks.values())).document()
        return result | {"earned": {name: hook.mean for name, hook in hooks.items()}}


def main() -> None:
    """Drive, print or write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=seeds_of, default=range(150100, 150106))
    parser.add_argument("--avs", type=int, default=4, help="of each episode, one at a time")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=PAGE)
    args = parser.parse_args()
    columns = ("reward", *WITH_MISSION)
    lines = [markdown_row(columns), markdown_row(["---"] * len(columns))]
    found: dict[tuple[str, str], str] = {}
    for world in WITH_MISSION:
        base = replace(case_of("altruist-rule", world, "contested", PHI), preset=Preset.LAWFUL)
        cases = [
            replace(base, policy=f"{who}{word}").with_seed(seed)
            for seed in args.seeds
            for who in range(args.avs)
            for word in ("", " slow")
        ]
        tasks = [Task(f"{case.policy} {case.seed}", world, (case,)) for case in cases]
        driven = spread(LocalEngine(Earning, workers=args.workers), tasks, world)
        for name in SETTINGS:
            fast, slow = (np.array([d["earned"][name] or math.nan for d in driven[k::2]]) for k in (0, 1))
            gain = paired_mean(list(fast), list(slow))
            found[name, world] = f"{gain.text(2)} of {mean(list(fast)).value:.2f}"
    lines += [markdown_row([name, *(found[name, world] for world in WITH_MISSION)]) for name in SETTINGS]
    about = [
        *("# Does falling back pay?", ""),
        f"Made by `python -m benchmarks.falling_back --seeds {args.seeds.start}:{args.seeds.stop}"
        f" --avs {args.avs}`: `contested`,",
        f"moderate drivers (`lc2013`), errors `none`, preset `lawful`, {len(args.seeds)} tuning seeds and"
        f" {args.avs} AVs of each.",
        f"All drive by `altruist-rule`; what one AV gains by driving at {SLOW:g} of its first speed,",
        f"per decision at phi {PHI:g} degrees (mean of pairs, bootstrap 95 % interval), of what it earns",
        "otherwise.",
        "",
    ]
    write_page(args.out, [*about, *lines])
    print(args.out.read_text())


if __name__ == "__main__":
    main()
