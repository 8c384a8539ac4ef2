"""What another action would have changed: how good an agent's choices are, one by one.

    python -m benchmarks.action_values POLICY [POLICY ...] [--seeds 150200:150205] [--copies 12]
        [--worlds merge] [--demand contested] [--errors none] [--svo 60] [--workers 2] [--out FILE]
    python -m benchmarks.action_values POLICY [POLICY ...] --run DIR

POLICY (a name, weights or a training's folder) drives every world with a mission vehicle. At drawn decisions
one AV does otherwise for 2.4 s in a copy of the simulation, everybody else as before by the same draws
(`cosim.learning.forks`); what the 12 s from there on bring more or less is the true difference between the
two actions, in units of the reward of `--config rewards`. Tuning seeds by default.

With `--run` nothing is driven: several networks are compared by the same copies, those that a training with
`training.forks` drove (its folder's `replay`). What that training's own network says of them it has learned.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.reward_balance import DEMANDS, REWARDS
from benchmarks.tables import markdown_row, write_page
from benchmarks.turn import resampled
from benchmarks.worlds import WITH_MISSION
from cosim.cli.arguments import seeds as seeds_of
from cosim.errors import BadInput
from cosim.learning.rollouts import Rollouts
from cosim.policies import make
from cosim.report.statistics import NA
from cosim.rewards.svo import RewardP
from cosim.scenario.policy_name import label, read
from cosim.types import Preset
from policy.agents.prediction_aware import PredictionAware
from policy.training import experience
from policy.training.curriculum import Drive, ForkConfig, Lesson
from policy.training.ddqn import DdqnConfig, differences
from policy.training.experience import Trajectory
from policy.training.explorer import ExploreConfig
from policy.training.replay_buffer import comparisons, places_tried

EVERYBODY = 1_000  # AVs that are recorded
MATTERS = 0.1  # reward from which on the choice counts as one that matters
COLUMNS = (
    *("policy", "episodes", "copies", "of which matter", "mean difference there", "chosen rightly"),
    *("lost a decision, of all copies", "correlation with the values"),
    *("for oneself: mean size true, valued, correlation", "for the others: the same"),
)


class Drawn(NamedTuple):
    """The copies of one episode."""

    true: np.ndarray  # [n] what the other action brought more
    found: np.ndarray  # [n] by the network's values
    apart: np.ndarray = np.zeros((2, 0, 2))  # both [n,2] before they are weighed: for oneself, and the others

    def by_values(self) -> Drawn:
        """The same as if the action of the higher value had been chosen, whoever drove."""
        side = np.where(self.found > 0.0, -1.0, 1.0)
        return Drawn(self.true * side, self.found * side, self.apart * side[:, None])


def judged(agent: PredictionAware, trajectories: Sequence[Trajectory]) -> Drawn:
    """What the network says of an episode's copies."""
    places = places_tried(trajectories)
    if not places:
        return Drawn(np.zeros(0), np.zeros(0))
    compared = comparisons(places)
    parts = [d.detach() for d in differences(agent.vfn, compared)]
    found, true = (agent.vfn.weighed(d[..., None], compared.now.phi)[:, 0].numpy() for d in parts)
    if agent.vfn.config.parts == 1:
        return Drawn(true, found)
    return Drawn(true, found, np.stack([parts[1].numpy(), parts[0].numpy() / DdqnConfig().scale]))


def row(policy: str, episodes: Sequence[Drawn]) -> str:
    """One line of a world's table."""
    true, found = (np.concatenate([one[k] for one in episodes]) for k in range(2))
    matter = np.abs(true) > MATTERS

    def stakes(one: Drawn) -> tuple[float, float]:
        counts = np.abs(one.true) * (np.abs(one.true) > MATTERS)
        return float((counts * (one.true < 0.0)).sum()), float(counts.sum())

    right, whole = (np.array(sums) for sums in zip(*map(stakes, episodes), strict=True))
    rightly = resampled(lambda a, b: float(100.0 * a / b) if b > 0.0 else math.nan, right, whole)
    each = [np.maximum(one.true, 0.0).mean() for one in episodes if len(one.true)]
    lost = resampled(float, np.array(each)) if each else NA
    correlation = float(np.corrcoef(true, found)[0, 1]) if len(true) > 1 else math.nan
    size = np.abs(true[matter]).mean() if matter.any() else math.nan
    parts = np.concatenate([one.apart for one in episodes], 1)
    apart = [_both(*parts[:, :, k]) for k in range(2)] if parts.size else ["-", "-"]
    cells = (
        *(policy, str(len(episodes)), str(len(true)), str(int(matter.sum())), f"{size:.2f}"),
        *(f"{rightly.text(0)} %", lost.text(3), f"{correlation:.2f}", *apart),
    )
    return markdown_row(cells)


def _both(true: np.ndarray, found: np.ndarray) -> str:
    sizes = f"{np.abs(true).mean():.2f}, {np.abs(found).mean():.2f}"
    return f"{sizes}, {np.corrcoef(true, found)[0, 1]:.2f}" if true.std() and found.std() else sizes


def of_run(agents: Mapping[str, PredictionAware], driven: Sequence[Trajectory]) -> dict[str, list[str]]:
    """The lines of every world and demand, practice roads together, of copies that a training drove.

    Args:
        agents: label -> the agent whose network is judged.
        driven: what the training holds in its replay buffer.
    """
    episodes: dict[str, list[Trajectory]] = {}
    for one in driven:
        episodes.setdefault(one.episode, []).append(one)
    places: dict[str, list[list[Trajectory]]] = {}
    for name, trajectories in sorted(episodes.items()):
        place = "practice" if name.startswith("practice/") else name.rpartition("/")[0]
        places.setdefault(place, []).append(trajectories)
    return {
        place: [row(name, [judged(agent, t).by_values() for t in there]) for name, agent in agents.items()]
        for place, there in places.items()
    }


def page(tables: Mapping[str, Sequence[str]]) -> list[str]:
    """The tables under their titles."""
    head = markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))
    return [line for title, rows in tables.items() for line in (f"## {title}", "", *head, *rows, "")]


def main() -> None:
    """Drive, print the page or write it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", nargs="+")
    parser.add_argument("--seeds", default="150200:150205")
    parser.add_argument("--copies", type=int, default=12, help="an episode")
    parser.add_argument("--worlds", nargs="+", default=list(WITH_MISSION), choices=WITH_MISSION)
    parser.add_argument("--demand", default="contested", choices=DEMANDS)
    parser.add_argument("--errors", default="none")
    parser.add_argument("--svo", type=float, default=60.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--run", type=Path, help="folder of a training that drove copies: judge those")
    args = parser.parse_args()
    agents: dict[str, PredictionAware] = {}
    for text in args.policy:
        agent = make(read(text).text)
        if not isinstance(agent, PredictionAware) or agent.config.vfn_weights is None:
            parser.error(f"{text} has no value network")
        agents[label(text)] = agent
    if args.run:
        try:
            held = experience.drives(args.run)
        except BadInput as error:
            parser.error(f"argument --run: {error}")
        print("\n".join([f"Copies of the training in `{args.run}`.", "", *page(of_run(agents, held))]))
        return
    tables: dict[str, list[str]] = {world: [] for world in args.worlds}
    for name, agent in agents.items():
        weights, explore = str(agent.config.vfn_weights), ExploreConfig(EVERYBODY, advised=False)
        with Rollouts(args.workers, agent.name, agent.config, explore, RewardP(REWARDS.reward)) as actors:
            drives = [
                Drive(
                    *(Lesson(world, args.demand), seed, math.radians(args.svo), 0.0, weights, weights),
                    record=True,
                    errors="" if args.errors == "none" else args.errors,
                    preset=Preset.LAWFUL,
                    forks=ForkConfig(args.copies, horizon=30),
                    gamma=0.97,
                )
                for world in args.worlds
                for seed in seeds_of(args.seeds)
            ]
            driven = [actors.submit(drive) for drive in drives]
            found = [judged(agent, future.result().trajectories) for future in driven]
        for world in args.worlds:
            mine = [one for drive, one in zip(drives, found, strict=True) if drive.lesson.scenario == world]
            tables[world].append(row(name, mine))
    where = "" if args.worlds == list(WITH_MISSION) else f" --worlds {' '.join(args.worlds)}"
    flags = f"--seeds {args.seeds} --copies {args.copies} --demand {args.demand}"
    flags += f" --errors {args.errors} --svo {args.svo:g}{where}"
    names = " ".join(agents)
    lines = [
        "# What another action would have changed",
        "",
        f"`python -m benchmarks.action_values {names} {flags}`:",
        f"`{args.demand}`, {DEMANDS[args.demand]} drivers (`lc2013`), preset `lawful`, errors"
        f" `{args.errors}`. At drawn",
        "decisions one AV does otherwise for 2.4 s in a copy of the simulation; what the 12 s from there on",
        "bring more or less, discounted, is the true difference, in units of reward; it matters above"
        f" {MATTERS}.",
        "*Chosen rightly*: the share of what is at stake where the agent's own choice was the better one.",
        "*Lost*: what the other action would have brought more, 0 where the agent chose rightly."
        " *Correlation*",
        "of the true difference with that of the network's values: whether it knows how much is at stake.",
        "*For oneself* and *for the others*: the mean size of the difference's two parts, before phi weighs",
        "them, by the copies and by a network that values them apart, and the correlation of both: one that",
        "values what is not there chooses by chance.",
        "95 % intervals: bootstrap over episodes. What two AVs together could change no copy shows.",
        "",
    ]
    lines += page(tables)
    if args.out:
        write_page(args.out, lines)
    else:
        print("\n".join(lines))


if __name__ == "__main__":
    main()
