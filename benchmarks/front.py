"""What each habit of the lawful car costs everybody in delay, and buys in safety.

    python -m benchmarks.front [--each N] [--habits NAME ...] [--duration S] [--workers N] [--again]
                               [--out docs/results]

Each habit is taken away, or one of its constants is changed, on the same random validation roads that are
full; beside them stand the drivers that SUMO itself offers. Delay is that of errors `field`, collisions are
those of `stress`. Rows are kept in docs/results/data/front.csv; the page and its picture are made of them.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from benchmarks.drives import Case, measure
from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.report.statistics import Figure as Estimate
from cosim.report.statistics import paired_change, pooled_rate
from research.picture import save
from sumo_scenarios.full_roads import LARGEST, FullRoad, full_roads
from sumo_scenarios.roads import NAMED

RESULTS = Path("docs/results")
PAGE, PICTURE, DATA = "front.md", "front.svg", "data/front.csv"
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
    errors: str
    seed: int  # of the road and of its traffic
    total_delay_s: float
    av_involved_collisions: float
    av_caused_collisions: float
    av_km: float
    hard_brakings_av: float


def case(habit: str, errors: str, road: FullRoad, duration: float | None) -> Case:
    """One episode; `duration`: s, None: to its end."""
    options: dict[str, Any] = {
        **{"policy": "car-alone", "penetration": 0.2, "behavior": "moderate"},
        **HABITS[habit].options,
        **{"what": str(road.folder), "errors": errors, "seed": road.seed, "duration": duration},
    }
    constants = {f"{RULES}.{name}": value for name, value in HABITS[habit].constants.items()}
    return Case((habit, errors, road.seed), options, constants)


class Point(NamedTuple):
    """What one habit came to."""

    habit: str
    delay: float  # s, of everybody, errors `field`
    change: Estimate  # of the delay, relative to the car's
    hit: Estimate  # collisions that an AV was in, in `PER` AV-km, errors `stress`
    caused: float
    brakings: float  # hard ones of AVs in an AV-km, errors `field`


def paired(rows: Sequence[Drive]) -> dict[str, list[Drive]]:
    """Habit -> its drives on all roads that the car drove under both errors; only habits that have all."""
    driven = {(row.errors, row.seed) for row in rows if row.habit == CAR}
    seeds = {seed for _, seed in driven if all((errors, seed) in driven for errors in ERRORS)}
    found = {habit: [row for row in rows if row.habit == habit and row.seed in seeds] for habit in HABITS}
    return {habit: of for habit, of in found.items() if of and len(of) == len(found[CAR])}


def points(rows: Sequence[Drive]) -> Iterator[Point]:
    """Habit by habit, of paired drives."""
    of_car: list[float] = []
    for habit, of in paired(rows).items():
        calm, stress = (sorted(r for r in of if r.errors == errors) for errors in ERRORS)
        delays = [row.total_delay_s for row in calm]
        of_car = of_car or delays  # the car is the first
        hits, km = ([getattr(row, c) for row in stress] for c in ("av_involved_collisions", "av_km"))
        hit = pooled_rate(hits, [one / PER for one in km]) if sum(km) > 0.0 else Estimate(*[math.nan] * 3)
        driven = sum(row.av_km for row in calm)
        brakings = sum(row.hard_brakings_av for row in calm) / driven if driven > 0.0 else math.nan
        caused = sum(row.av_caused_collisions for row in stress)
        yield Point(habit, fmean(delays), paired_change(of_car, delays), hit, caused, brakings)


# ---- what is written ----


def page(rows: Sequence[Drive]) -> list[str]:
    """The page."""
    columns = ["", "delay, s", "change", "collisions", "caused by AVs", "hard brakings"]
    lines = markdown_head(columns)
    lines += [markdown_row([one.habit, *_cells(one)]) for one in points(rows)]
    count = len({row.seed for row in paired(rows).get(CAR, ())})
    of = {"largest": LARGEST, "count": count, "each": count // len(NAMED), "picture": PICTURE, "data": DATA}
    return WORDS.format(table="\n".join(lines), **of).splitlines()


def _cells(one: Point) -> list[str]:
    change = "" if one.habit == CAR else one.change.text(0, 100.0) + " %"
    if math.isnan(one.hit.value):
        return [f"{one.delay:.1f}", change, "", "", ""]
    return [f"{one.delay:.1f}", change, one.hit.text(0), f"{one.caused:.0f}", f"{one.brakings:.2f}"]


def picture(rows: Sequence[Drive], file: Path) -> None:
    """Delay against collisions, a point a habit."""
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.subplots()
    for number, one in enumerate(sorted(points(rows), key=lambda point: point.delay)):
        if math.isnan(one.hit.value):
            axes.axvline(one.delay, color="0.6", linestyle=":")
            axes.text(one.delay, 0.0, " no AVs", fontsize=8, color="0.4", va="bottom")
            continue
        below, above = one.hit.value - one.hit.low, one.hit.high - one.hit.value
        mark = "o" if HABITS[one.habit].is_car else "s"
        colour = "C3" if one.habit == CAR else "C0" if mark == "o" else "0.5"
        axes.errorbar(one.delay, one.hit.value, [[below], [above]], fmt=mark, color=colour, elinewidth=0.6)
        axes.annotate(
            one.habit.strip("`"),
            (one.delay, one.hit.value),
            (4, (4, -11)[number % 2]),
            textcoords="offset points",
        )
    axes.set_ylim(bottom=0.0)
    axes.margins(x=0.15)  # for the last label
    axes.set_xlabel("mean delay of everybody, s")
    axes.set_ylabel("collisions with an AV in 1,000 AV-km")
    for text in axes.texts:
        text.set_fontsize(8)
    save(figure, file)


WORDS = """# The lawful car: what each habit costs and buys

Each row takes one habit of the car away, or changes one of its constants, on the same drives.
Delay is everybody's, under the driver errors `field`. Collisions are those with an AV in 1,000
AV-km, under `stress`. Hard brakings are those of AVs in an AV-km, under `field`. Brackets hold 95 %
intervals over roads.

{table}

![Delay against collisions]({picture})

## Conditions

{count} random roads of the validation seeds, equally many of each kind, whose demand is at least
their nominal capacity, and at most {largest:,.0f} vehicles/h ([formats](../reference/formats.md)).
Drivers `moderate`, 20 % AVs that always ask for more speed, sensing `ideal`. Test roads are not
among them. Rows: [{data}]({data}).

```
python -m benchmarks.front --each {each}
```
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure what is missing, keep, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--each", type=int, default=2, metavar="N", help="roads of a kind")
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
    with tempfile.TemporaryDirectory() as folder:
        cases = [
            case(habit, errors, road, args.duration)
            for road in full_roads(args.each, Path(folder))
            for errors in ERRORS
            for habit in args.habits
        ]
        rows = measure(Drive, cases, args.workers, args.out / DATA, args.again)
    picture(rows, args.out / PICTURE)
    write_page(args.out / PAGE, page(rows))
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
