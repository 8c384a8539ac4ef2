"""What an AV could not have avoided: its collisions among humans who err, driven again with another answer.

    python -m benchmarks.avoidable [--policy idm vfn-p] [--seeds 200000:200040] [--workers 2]

Every episode of docs/results/humans.md's worlds is driven; where an AV is in a collision, it is driven again,
and from the decision at which the human's error begins until the collision the simulation is forked at every
decision (`cosim.simulation.sumo.SumoSimulator.ahead`): the AV brakes hard, brakes comfortably, speeds up, or
changes lanes, while all other AVs keep what they are commanded and the errors come as they are drawn. The
collision was avoidable if in one of these forks no AV is in any until `AFTER` s later. Who answers better, or
twice, is not tried: the share is a lower bound. Rows are kept in --rows, and not driven twice.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.humans import DEMAND, LEVEL, PAGE
from benchmarks.tables import fill, markdown_row
from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.record import planned
from cosim.cli.arguments import seeds as seeds_of
from cosim.control import COMFORT, MAX_DECEL
from cosim.episode import Episode, Hook, Step
from cosim.files import write_csv
from cosim.learning.prediction_data import spread
from cosim.report.result import error_of
from cosim.report.statistics import share
from cosim.scenario.episode_id import EpisodeId
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import Command, EpisodeResult, Snapshot
from cosim.workers.engines import LocalEngine
from cosim.workers.tasks import Progress, Task

AFTER = 3.0  # s
# what the AV does -> the acceleration in m/s2 that is forced, or the side it changes to
ANSWERS: dict[str, float | int] = {
    "brakes hard": -MAX_DECEL,
    "brakes": -COMFORT,
    "speeds up": COMFORT,
    "goes left": 1,
    "goes right": -1,
}
ROWS = Path("docs/results/data/avoidable.csv")
COLUMNS = (
    *("world", "demand", "policy", "episodes", "an AV in a collision", "a human erred", "avoidable"),
    *("by braking hard", "by braking", "by speeding up", "by changing lanes", "s before, median"),
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """One episode; what follows `collided` is of its first collision of an AV."""

    policy: str
    world: str
    seed: int
    collided: bool
    av_caused: bool = False
    error: str = ""  # kind of the human error that had a part, "" none had
    warned: float = 0.0  # s from its beginning to the collision
    answer: str = ""  # of ANSWERS, that would have avoided it; "": none
    left: float = 0.0  # s before the collision, at which that answer was the first that avoided it


class Forks(Hook):
    """Looks ahead at every decision of `begin` to `end` (s): which answer of `av` avoids every collision?"""

    def __init__(self, av: str, begin: float, end: float) -> None:
        self._av, self._begin, self._end = av, begin, end
        self.answer, self.at = "", math.nan

    def on_step(self, episode: Episode, step: Step) -> None:
        """After a decision has been carried out."""
        now = episode.snapshot.time
        if self.answer or not self._begin <= now < self._end or self._av not in episode.snapshot.row:
            return
        frames = math.ceil((self._end - now + AFTER) / episode.scenario.timing.frame)
        target = episode.simulator.commanded(self._av)[0]
        for name, how in ANSWERS.items():
            if isinstance(how, int):
                speed = episode.snapshot.speed[episode.snapshot.row[self._av]] if target is None else target
                moved = Command(self._av, float(speed), how, episode.scenario.timing.decision)
                found = _look(episode, frames, [moved], {})
            else:
                found = _look(episode, frames, [], {self._av: how})
            if not any(c.involves_av for frame in found for c in frame.events.collisions):
                self.answer, self.at = name, now
                return


def _look(
    episode: Episode, frames: int, commands: Sequence[Command], forced: Mapping[str, float]
) -> tuple[Snapshot, ...]:
    simulator: Any = episode.simulator  # SUMO's own
    found: tuple[Snapshot, ...] = simulator.ahead(frames, commands, errors=True, forced=forced)
    return found


class Avoiding(EpisodeRunner):
    """Hosted by an engine's worker."""

    def run(self, case: EpisodeId, progress: Progress) -> Outcome:  # type: ignore[override]
        """Drives, and where an AV is in a collision drives again."""
        host = self.open(case, ())
        result: EpisodeResult = host.run(case.seed, progress)
        about = case.policy, Path(case.what).name, case.seed
        hit = next((c for c in result.collisions if c.involves_av), None)
        if hit is None:
            return Outcome(*about, False)
        error = error_of(hit, result.errors_begun)
        begin = hit.time - AFTER if error is None else error.time
        answer, left = "", 0.0
        for av, is_av in ((hit.victim, hit.victim_is_av), (hit.collider, hit.collider_is_av)):
            if is_av and not answer:
                forks = Forks(av, begin, hit.time)
                again = host.run(case.seed, progress, hooks=[forks])
                assert again.trace_hash == result.trace_hash, "looking ahead has changed the drive"
                answer, left = forks.answer, hit.time - forks.at if forks.answer else 0.0
        kind = "" if error is None else error.kind
        return Outcome(*about, True, hit.av_caused, kind, round(hit.time - begin, 2), answer, round(left, 2))


def line(world: str, policy: str, outcomes: Sequence[Outcome]) -> list[str]:
    """One world's cells, or of all together ("")."""
    hit = [o for o in outcomes if o.collided]
    erred = sum(bool(o.error) for o in hit)
    found = [o for o in hit if o.answer]
    by = Counter(o.answer for o in found)
    left = f"{median([o.left for o in found]):.1f}" if found else "-"
    return [
        *(world or "together", DEMAND.get(world, ""), policy, str(len(outcomes))),
        f"{len(hit)}: {share(len(hit), len(outcomes)).text(1, 100.0)} %",
        f"{erred} of {len(hit)}",
        f"{len(found)}: {share(len(found), len(hit)).text(0, 100.0)} %" if hit else "-",
        *(str(by[name]) for name in ("brakes hard", "brakes", "speeds up")),
        *(str(by["goes left"] + by["goes right"]), left),
    ]


def read(path: Path) -> dict[tuple[str, str, int], Outcome]:
    """(Policy, world, seed) -> what was driven before."""
    if not path.is_file():
        return {}
    with path.open(newline="") as file:
        rows = [
            Outcome(
                *(row["policy"], row["world"], int(row["seed"])),
                *(row["collided"] == "True", row["av_caused"] == "True", row["error"]),
                *(float(row["warned"]), row["answer"], float(row["left"])),
            )
            for row in csv.DictReader(file)
        ]
    return {(o.policy, o.world, o.seed): o for o in rows}


def main() -> None:
    """Drive what is missing, write rows and the page's table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", nargs="+", default=["idm", "vfn-p"])
    parser.add_argument("--seeds", type=seeds_of, default=range(FIRST_TEST_SEED, FIRST_TEST_SEED + 40))
    parser.add_argument("--rows", type=Path, default=ROWS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--page", type=Path, default=PAGE)
    args = parser.parse_args()
    done = read(args.rows)
    for policy in args.policy:
        for world, demand in DEMAND.items():
            plan = planned([world], [demand], [], [policy], args.seeds, errors=LEVEL)
            missing = [case for _, case in plan.cases() if (policy, world, case.seed) not in done]
            tasks = [Task(case.key, case.cell, (case,)) for case in missing]
            for outcome in spread(LocalEngine(Avoiding, workers=args.workers), tasks, f"{policy}, {world}"):
                done[outcome.policy, outcome.world, outcome.seed] = outcome
            write_csv(args.rows, [asdict(done[key]) for key in sorted(done)])
    lines = [markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))]
    for policy in args.policy:
        mine = [o for o in done.values() if o.policy == policy and o.seed in args.seeds]
        lines += [
            markdown_row(line(world, policy, [o for o in mine if world in ("", o.world)]))
            for world in (*DEMAND, "")
        ]
    fill(args.page, "avoidable", lines)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
