"""The search for the habits of `altruist`: `cosim train altruist`."""

import argparse
import json
import shlex
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cosim.batch.episode_runner import EpisodeRunner
from cosim.errors import BadInput
from cosim.files import working_in
from cosim.learning.announcement import announce, begun, curves
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.policy_name import BEST
from cosim.seeding import TRAINING_SEEDS, generator
from cosim.types import Floats, Policy
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import Progress
from cosim.workers.tasks import Progress as Heartbeat
from cosim.workers.tasks import Task
from policy.agents.altruist import NAME, Altruist, save
from policy.agents.yield_rule import Habits
from policy.training.loop import tensorboard
from policy.training.search import POPULATION, Search, mean_ranks
from sumo_scenarios.full_roads import KINDS, full_roads

GENERATIONS = 30
CONTESTED = ("merge", "exit", "roundabout", "intersection")
SHARES = (0.1, 0.2, 0.4)  # of AVs on full roads
DURATION = 400.0  # s of a full road: shows what yielding saves, in a fifth of a whole drive's time
SVO = 45.0  # deg
WAITING = 0.3  # s of delay that 1 s2 of a squared wait costs
LOG = "log.jsonl"


class Trials(EpisodeRunner):
    """Runs in a worker: episodes, each with the habits of a candidate."""

    def __init__(self) -> None:
        super().__init__()
        self._agent = Altruist()

    def policy(self, case: EpisodeOptions) -> str | Policy:
        """The candidate."""
        return self._agent

    def run(self, case: EpisodeOptions, habits: Habits, progress: Heartbeat) -> float:  # type: ignore[override]
        """The cost of an episode, s: everybody's mean delay, and waits; a long wait weighs more."""
        self._agent.habits = habits
        found = self.open(case, ()).run(case.seed, progress).document()
        return float(found["total_delay_s"] + WAITING * found["mean_squared_wait_s2"])


def roads(seed: int, generations: int, folder: Path) -> Iterator[list[EpisodeOptions]]:
    """The episodes of each generation: a full road of each kind, and the contested scenarios."""
    drawn: dict[str, list[EpisodeOptions]] = {kind: [] for kind in KINDS}
    order = generator(seed, "roads").permutation(TRAINING_SEEDS).tolist()
    common: dict[str, Any] = {"policy": "yield-rule", "svo_deg": SVO, "errors": "field"}
    for road in full_roads(generations, folder, KINDS, order):
        share = SHARES[road.seed % len(SHARES)]
        at = EpisodeOptions(str(road.folder), seed=road.seed, penetration=share, duration=DURATION, **common)
        drawn[road.kind].append(at)
    for full, traffic in zip(zip(*drawn.values(), strict=True), order, strict=False):
        contested = (
            EpisodeOptions(name, seed=traffic, demand=("contested",), preset="lawful", **common)
            for name in CONTESTED
        )
        yield [*full, *contested]


def train(args: argparse.Namespace) -> int:
    """`cosim train altruist`. Raises BadInput for invalid input before the first episode."""
    generations, seed = args.iterations or GENERATIONS, args.seed or 0
    drives = generations * POPULATION * (len(KINDS) + len(CONTESTED))
    announce(
        f"train {NAME}: {generations} generations of {POPULATION} candidates, {drives:,} drives",
        {
            "roads": f"random full ones ({', '.join(KINDS)}) and {', '.join(CONTESTED)} (contested)",
            "curves": curves(shlex.quote(args.out), LOG),
            "interrupt": "Ctrl-C; --resume continues, at most one generation is lost",
        },
    )
    with working_in(args.out) as folder, tempfile.TemporaryDirectory() as scratch:
        log = folder / LOG
        begun(log, args)
        search, done = _resumed(log, seed)
        with (
            closing(tensorboard(folder, done)) as writer,
            Progress(f"train {NAME}", "generations") as progress,
        ):
            for number, cases in enumerate(roads(seed, generations, Path(scratch))):
                if number < done:
                    continue
                candidates = search.ask()
                costs = _driven(cases, candidates, args.workers)
                search.tell(ranks := mean_ranks(costs))
                line = {"seed": seed, "generation": number, "ranks": ranks, "costs": costs.round(2).tolist()}
                line |= {"centre": asdict(search.centre), "spread": search.spread}
                with log.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
                for name, value in asdict(search.centre).items():
                    writer.add_scalar(f"habits/{name}", value, number)
                writer.add_scalar("spread", search.spread, number)
                about = {"seed": seed, "generations": number + 1, "drives": (number + 1) * costs.size}
                save(folder / BEST, search.centre, {"spread": search.spread}, about)
                progress(number + 1, generations)
        driven = max(done, generations)
        print(f"{NAME}: {driven} generation{'s' * (driven != 1)}")
        for name, value in asdict(search.centre).items():
            print(f"  {value:7.2f}  {name}")
        print(f"  {folder / BEST}")
        return 0


# ---- inside ----


def _resumed(log: Path, seed: int) -> tuple[Search, int]:
    """The search after the generations in the log. Raises BadInput for the log of another seed."""
    search = Search(seed)
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    for line in map(json.loads, lines):
        if line["seed"] != seed:
            raise BadInput(
                "the run in this folder has another seed", file=log, field="seed", value=line["seed"]
            )
        search.ask()
        search.tell(line["ranks"])
    return search, len(lines)


def _driven(cases: list[EpisodeOptions], candidates: list[Habits], workers: int) -> Floats:
    """The cost of every candidate on every road [roads, candidates], s."""
    costs = np.zeros((len(cases), len(candidates)))
    tasks = {
        f"{row}/{column}": (row, column, Task(f"{row}/{column}", str(row), (case, habits)))
        for row, case in enumerate(cases)
        for column, habits in enumerate(candidates)
    }
    with (
        closing(
            LocalEngine(Trials, workers=workers).run([task for _, _, task in tasks.values()])
        ) as outcomes,
        Progress("generation", "drives") as progress,
    ):
        for done, outcome in enumerate(outcomes, 1):
            row, column, _ = tasks[outcome.key]
            costs[row, column] = outcome.result()
            progress(done, len(tasks))
    return costs
