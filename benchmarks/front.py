"""What each habit of the lawful car costs everybody in delay, and buys in safety.

    python -m benchmarks.front [--seeds A:B] [--roads NAME ...] [--habits NAME ...] [--duration S]
                               [--workers N] [--again] [--out docs/results]

Each habit is taken away, or one of its constants is changed, on the same drives; beside them stand the
drivers that SUMO itself offers. Delay is that of errors `field`, collisions are those of `stress`. Rows are
kept in docs/results/data/front.csv; the page and its picture are made of them.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from matplotlib import rc_context
from matplotlib.figure import Figure

from benchmarks.drives import Case, measure
from benchmarks.tables import markdown_row, write_page
from cosim.report.statistics import Figure as Rate
from cosim.report.statistics import pooled_rate
from cosim.seeding import TUNING_SEEDS

RESULTS = Path("docs/results")
PAGE, PICTURE, DATA = "front.md", "front.svg", "data/front.csv"
ROADS = ("lane_drop", "on_ramp")
DELAY, SAFETY = ERRORS = ("field", "stress")
RULES = "cosim.simulation.lawful"
CAR = "the car"
PER = 1000.0  # AV-km, in which collisions are counted
NEVER = math.inf


@dataclass(frozen=True)
class Habit:
    """One way to drive the AVs: the car with constants changed (`module.NAME`), or other options."""

    constants: dict[str, object] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def is_car(self) -> bool:
        """Whether the lawful car drives."""
        return "policy" not in self.options


HABITS = {
    CAR: Habit(),
    "headway 0.6 s": Habit({"follower.HEADWAY": 0.6}),
    "headway 1.2 s": Habit({"follower.HEADWAY": 1.2}),
    "headway 1.8 s": Habit({"follower.HEADWAY": 1.8}),
    "no early braking": Habit({"leader.VEHICLES_BEYOND_LEADER": 0}),
    "no room for who closes in": Habit({"follower.EVASION_DECELS": (NEVER, NEVER)}),
    "no more space before a human": Habit({"follower.STANDSTILL_GAPS": (2.0, 2.0)}),
    "no courtesy (phi 0)": Habit(options={"svo_deg": 0.0}),
    "`idm`": Habit(options={"policy": "idm"}),
    "`idm-courteous`": Habit(options={"policy": "idm-courteous"}),
    "no AVs": Habit(options={"policy": "idm", "penetration": 0.0}),
}


class Drive(NamedTuple):
    """A row of the CSV."""

    habit: str
    road: str
    errors: str
    seed: int
    total_delay_s: float
    av_involved_collisions: float
    av_caused_collisions: float
    av_km: float
    hard_brakings_av: float


def case(habit: str, road: str, errors: str, seed: int, duration: float | None) -> Case:
    """One episode; `duration`: s, None: to its end."""
    options: dict[str, Any] = {
        **{"policy": "car-alone", "penetration": 0.2, "behavior": "moderate", "demand": ("over",)},
        **HABITS[habit].options,
        **{"what": f"open/{road}", "errors": errors, "seed": seed, "duration": duration},
    }
    constants = {f"{RULES}.{name}": value for name, value in HABITS[habit].constants.items()}
    return Case((habit, road, errors, seed), options, constants)


class Point(NamedTuple):
    """What one habit came to."""

    habit: str
    delays: tuple[float, ...]  # s, of everybody, by road, errors `field`
    hit: Rate  # collisions that an AV was in, in `PER` AV-km, errors `stress`
    caused: float
    brakings: float  # hard ones of AVs in an AV-km, errors `field`

    @property
    def delay(self) -> float:
        """s, the mean of the roads."""
        return fmean(self.delays)


def paired(rows: Sequence[Drive]) -> dict[str, list[Drive]]:
    """Habit -> its drives of all seeds that the car drove on every road, under both errors."""
    roads = {row.road for row in rows}
    drives = Counter(row.seed for row in rows if row.habit == CAR)
    seeds = {seed for seed, count in drives.items() if count == len(roads) * len(ERRORS)}
    found = {habit: [row for row in rows if row.habit == habit and row.seed in seeds] for habit in HABITS}
    return {habit: of for habit, of in found.items() if of and len(of) == len(found[CAR])}


def points(rows: Sequence[Drive]) -> Iterator[Point]:
    """Habit by habit, of paired drives."""
    roads = list(dict.fromkeys(row.road for row in rows))
    for habit, of in paired(rows).items():
        calm, stress = ([row for row in of if row.errors == errors] for errors in ERRORS)
        late = [[row.total_delay_s for row in calm if row.road == road] for road in roads]
        hits, km = ([getattr(row, c) for row in stress] for c in ("av_involved_collisions", "av_km"))
        hit = pooled_rate(hits, [one / PER for one in km]) if sum(km) > 0.0 else Rate(*[math.nan] * 3)
        driven = sum(row.av_km for row in calm)
        brakings = sum(row.hard_brakings_av for row in calm) / driven if driven > 0.0 else math.nan
        caused = sum(row.av_caused_collisions for row in stress)
        yield Point(habit, tuple(map(fmean, late)), hit, caused, brakings)


# ---- what is written ----


def page(rows: Sequence[Drive]) -> list[str]:
    """The page."""
    roads = dict.fromkeys(row.road for row in rows)
    seeds = sorted({row.seed for row in paired(rows).get(CAR, ())})
    columns = [*(f"`open/{road}`, s" for road in roads), "collisions", "caused by AVs", "hard brakings"]
    found = list(points(rows))
    table = [["", *columns], *([one.habit, *_cells(one)] for one in found)]
    lines = [markdown_row(line) for line in table]
    return WORDS.format(
        table="\n".join([lines[0], "|---" * (len(columns) + 1) + "|", *lines[1:]]),
        picture=PICTURE,
        seeds=", ".join(map(str, seeds)),
        span=f"{seeds[0]}:{seeds[-1] + 1}" if seeds else "A:B",
        data=DATA,
    ).splitlines()


def _cells(one: Point) -> list[str]:
    delays = [f"{delay:.1f}" for delay in one.delays]
    if math.isnan(one.hit.value):
        return [*delays, "", "", ""]
    hit = f"{one.hit.value:.0f} ({one.hit.low:.0f} to {one.hit.high:.0f})"
    return [*delays, hit, f"{one.caused:.0f}", f"{one.brakings:.2f}"]


def picture(rows: Sequence[Drive], file: Path) -> None:
    """Delay against collisions, a point a habit."""
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.subplots()
    for one in points(rows):
        if math.isnan(one.hit.value):
            axes.axvline(one.delay, color="0.6", linestyle=":")
            axes.text(one.delay, 0.0, " no AVs", fontsize=8, color="0.4", va="bottom")
            continue
        below, above = one.hit.value - one.hit.low, one.hit.high - one.hit.value
        mark = "o" if HABITS[one.habit].is_car else "s"
        colour = "C3" if one.habit == CAR else "C0" if mark == "o" else "0.5"
        axes.errorbar(one.delay, one.hit.value, [[below], [above]], fmt=mark, color=colour, elinewidth=0.6)
        axes.annotate(one.habit.strip("`"), (one.delay, one.hit.value), (4, 4), textcoords="offset points")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("mean delay of everybody, s")
    axes.set_ylabel("collisions with an AV in 1,000 AV-km")
    for text in axes.texts:
        text.set_fontsize(8)
    with rc_context({"svg.hashsalt": "front", "svg.fonttype": "none"}):
        figure.savefig(file, metadata={"Date": None})


WORDS = """# The lawful car: what each habit costs and buys

Each row takes one habit of the car away, or changes one of its constants, on the same drives.
Delay is everybody's, under the driver errors `field`. Collisions are those with an AV in 1,000
AV-km, under `stress`, with 95 % intervals. Hard brakings are those of AVs in an AV-km, under
`field`.

{table}

![Delay against collisions]({picture})

## Conditions

Demand `over`, drivers `moderate`, 20 % AVs that always ask for more speed, sensing `ideal`.
Validation seeds: {seeds}. Each delay is a mean over them. One seed scatters by a third, so small
differences of delay say nothing. Rows: [{data}]({data}).

```
python -m benchmarks.front --seeds {span}
```
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure what is missing, keep, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    first = TUNING_SEEDS.start
    parser.add_argument("--seeds", default=f"{first + 20}:{first + 24}", metavar="A:B")
    parser.add_argument("--roads", nargs="*", default=ROADS, metavar="NAME")
    parser.add_argument("--habits", nargs="*", default=[*HABITS], choices=[*HABITS], metavar="NAME")
    parser.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help="of each drive, for a folder of its own; default: to the end",
    )
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--again", action="store_true", help="also what is measured")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FOLDER")
    args = parser.parse_args(arguments)
    data, seeds = args.out / DATA, range(*map(int, args.seeds.split(":")))
    cases = [
        case(habit, road, errors, seed, args.duration)
        for seed in seeds
        for errors in ERRORS
        for road in args.roads
        for habit in args.habits
    ]
    rows = measure(Drive, cases, args.workers, data, args.again)
    picture(rows, args.out / PICTURE)
    write_page(args.out / PAGE, page(rows))
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
