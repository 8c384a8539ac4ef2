"""What do 100 s of yielding bring? Exact copies of one simulation differ in these 100 s alone.

    python -m benchmarks.yielding_window [--each N] [--kinds KIND ...] [--workers N] [--again]
                                         [--out docs/results]

At four times of a drive on a full random validation road the process is copied (`cosim.simulation.fork`).
In each copy AVs follow one habit of `yield-rule` for 100 s, or none, or one for vehicles that need it of
another AV; then the car alone drives on. Rows are kept in docs/results/data/yielding_window.csv.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import NamedTuple, get_type_hints

from benchmarks.drives import read, write
from benchmarks.tables import markdown_head, markdown_row, write_page
from benchmarks.yielding import COLUMNS, HABITS, RESULTS, SHIPPED, case
from cosim.episode import Episode, Hook, Step, drive_on
from cosim.host import Host
from cosim.report.statistics import Figure, grouped_mean
from cosim.scenario.options import EpisodeOptions
from cosim.simulation.fork import forked
from cosim.types import Decision, History, PolicyContext
from policy.agents import yield_rule
from policy.inputs.needs import Need, Needs
from sumo_scenarios.full_roads import EACH, FullRoad, full_roads

PAGE, DATA = "yielding_window.md", "data/yielding_window.csv"
KINDS = ("lane_drop", "on_ramp", "weave", "minor", "roundabout")  # an arterial's AVs do not yield
NEVER, EXCHANGED = "never yields", "eases off as another AV should"
BRANCHES: dict[str, tuple[str, bool]] = {  # the constant that is on, and whether AVs exchange their needs
    NEVER: ("", False),
    **{habit: (constant, False) for habit, constant in HABITS.items()},
    EXCHANGED: ("EASES_OFF", True),
}
YIELDING = tuple(branch for branch in BRANCHES if branch != NEVER)
TIMES = (100.0, 200.0, 300.0, 400.0)  # s, when the copies part
AFTER = (100, 200, 400)  # s later, when the delay is read; the window ends at the first


class Branch(NamedTuple):
    """A row of the CSV: one copy. Delays are sums over all vehicles due so far."""

    kind: str  # of road
    seed: int  # of the road and of its traffic
    time: float  # s, when the copies parted
    branch: str  # of `BRANCHES`
    yieldings: int  # begun in the window
    after_100_s: float  # s of delay of everybody together
    after_200_s: float
    after_400_s: float


class Exchanged(Needs):
    """Needs; if `on`, each AV gets those of another one: as many, of vehicles that it cannot help."""

    on = False

    def find(self, histories: Mapping[str, History]) -> dict[str, list[Need]]:
        """See `Needs`."""
        needs = super().find(histories)
        if not self.on:
            return needs
        drawn = sorted(histories, key=lambda av: random.Random(av).random())  # neighbours have like names
        return {av: needs.get(other, []) for av, other in zip(drawn, drawn[1:] + drawn[:1], strict=True)}


class Counted(yield_rule.YieldRule):
    """`yield-rule`, which counts how often an AV has begun to let a vehicle go."""

    def reset(self, context: PolicyContext) -> None:
        """As `YieldRule` does."""
        super().reset(context)
        self._needs = Exchanged(context)
        self.served: frozenset[tuple[str, str, int]] = frozenset()

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """As `YieldRule` does."""
        decisions = super().decide(histories)
        self.served = self.served | self._serves
        return decisions


class Windows(Hook):
    """Copies the simulation at each of `TIMES`, and drives on in the copies."""

    def __init__(self, policy: Counted, kind: str, branches: Sequence[str] = tuple(BRANCHES)) -> None:
        self.policy, self.kind, self.branches = policy, kind, branches
        self.rows: list[Branch] = []
        self._times = [*TIMES]

    def on_step(self, episode: Episode, step: Step) -> None:
        """Drive every branch, if it is time."""
        if self._times and episode.elapsed >= self._times[0]:
            time = self._times.pop(0)
            for branch in self.branches:
                self.rows.append(forked(partial(self._drive_on, episode, time, branch)))

    def _drive_on(self, episode: Episode, time: float, branch: str) -> Branch:
        """In a copy of the process: count yieldings in the window, then the sums of delay."""
        self._times, began = [], episode.elapsed
        _yield(branch)
        self.policy.served = frozenset()
        yieldings, delays = 0, []
        for after in AFTER:
            drive_on(episode, self.policy, began + after)
            if after == AFTER[0]:
                yieldings = len(self.policy.served)
                _begin("")  # what has begun goes on until it ends, with the needs exchanged or not
            figures = episode.result(self.policy.name).metrics
            due, mean = (figures[name].value for name in ("vehicles_due", "total_delay_s"))
            delays.append(math.nan if due is None or mean is None else round(due * mean, 1))
        return Branch(self.kind, episode.seed, time, branch, yieldings, *delays)


def _yield(branch: str) -> None:
    """Turn on the habit of this branch alone."""
    on, Exchanged.on = BRANCHES[branch]
    _begin(on)


def _begin(on: str) -> None:
    """AVs begin to yield by the habit of this constant alone; "": by none."""
    for constant in HABITS.values():
        setattr(yield_rule, constant, constant == on)


def drive(road: FullRoad, branches: Sequence[str]) -> list[Branch]:
    """These copies of one drive; changes constants of this process."""
    _yield(NEVER)
    policy = Counted()
    windows = Windows(policy, road.kind, branches)
    options = EpisodeOptions(**case(SHIPPED, road, TIMES[-1] + AFTER[-1] + 1.0).options)
    with closing(Host(options.scenario(), policy, math.radians(options.svo_deg))) as host:
        host.run(road.seed, hooks=[windows])
    return windows.rows


def _order(row: Branch) -> tuple[int, int, float, int]:
    return KINDS.index(row.kind), row.seed, row.time, [*BRANCHES].index(row.branch)


# ---- the page ----


def page(rows: Sequence[Branch]) -> list[str]:
    """The change by each habit, by kind of road."""
    return WORDS.format(
        answer=fill(" ".join(_answers(rows)), COLUMNS),
        table="\n".join(_table(rows)),
        conditions=fill(CONDITIONS.format(roads=_roads(rows), data=DATA), COLUMNS),
    ).splitlines()


def _roads(rows: Sequence[Branch]) -> str:
    counts = Counter(kind for kind, _ in {(row.kind, row.seed) for row in rows})
    return ", ".join(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind])


def _answers(rows: Sequence[Branch]) -> Iterator[str]:
    for habit in YIELDING:
        windows = sum(row.branch == habit and row.yieldings > 0 for row in rows)
        changes = zip(_changes(rows, habit), AFTER, strict=True)
        at = [f"{change.text(0)} s after {after} s" for change, after in changes]
        yield f"An AV that {habit} ({windows} windows): {', '.join(at)}."


def _changes(rows: Sequence[Branch], habit: str) -> list[Figure]:
    """At each of `AFTER`: the change of the sum of delay against the copy that never yields, s a window.

    Only windows in which an AV has yielded.
    """
    never = {(row.seed, row.time): row for row in rows if row.branch == NEVER}
    of = [row for row in rows if row.branch == habit and row.yieldings]
    roads = [row.seed for row in of]
    return [
        grouped_mean([getattr(row, name) - getattr(never[row.seed, row.time], name) for row in of], roads)
        for name in (f"after_{after}_s" for after in AFTER)
    ]


def _table(rows: Sequence[Branch]) -> Iterator[str]:
    yield from markdown_head(["", "", "windows", "yieldings in each", *(f"after {a} s" for a in AFTER)])
    for habit in YIELDING:
        name = habit  # in its first row only
        for kind in KINDS:
            of = [row for row in rows if row.kind == kind]
            yielded = [row.yieldings for row in of if row.branch == habit and row.yieldings]
            if yielded:
                changes = [change.text(0) for change in _changes(of, habit)]
                each = f"{sum(yielded) / len(yielded):.0f}"
                yield markdown_row([name, f"`{kind}`", str(len(yielded)), each, *changes])
                name = ""


CONDITIONS = (
    "Random full roads of the validation seeds: {roads}. Windows begin at 100, 200, 300 and 400 s. 20 % AVs, "
    "preset `lawful`, drivers `moderate`, errors `field`, sensing `ideal`, phi 45. Rows: [{data}]({data})."
)
WORDS = """# What do 100 s of yielding bring?

Exact copies of one simulation differ in 100 s alone. In these, AVs follow one habit of
[`yield-rule`](yielding.md) or never yield; before and afterwards the car drives alone. A
yielding under way then goes on to its end. As a control, each AV eases off for vehicles that signal
ahead of another AV. Change of the sum of all vehicles' delay, a window:

{answer}

## By kind of road

{table}

Brackets hold 95 % intervals over roads. Windows without a yielding are left out.

{conditions}

```
python -m benchmarks.yielding_window
```
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive what is missing, keep, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--each", type=int, default=2 * EACH, metavar="N", help="roads of a kind")
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS, metavar="KIND")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--again", action="store_true", help="also what is measured")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FOLDER")
    args = parser.parse_args(arguments)
    rows = [] if args.again else read(Branch, args.out / DATA)
    spawn = multiprocessing.get_context("spawn")
    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(args.workers, spawn, max_tasks_per_child=1) as pool,
    ):
        known = {(row.seed, row.branch) for row in rows}
        missing = {
            road: [branch for branch in BRANCHES if (road.seed, branch) not in known]
            for road in full_roads(args.each, Path(folder), args.kinds)
        }
        running = [pool.submit(drive, road, branches) for road, branches in missing.items() if branches]
        for number, done in enumerate(as_completed(running), 1):
            rows = sorted([*rows, *done.result()], key=_order)
            write(args.out / DATA, get_type_hints(Branch), rows)
            print(f"yielding_window {number}/{len(running)}", file=sys.stderr, flush=True)
    write_page(args.out / PAGE, page(rows))
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
