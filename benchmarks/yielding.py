"""Is there anything to learn? Scripted decisions beside the lawful car, on random roads that are full.

    python -m benchmarks.yielding [--each N] [--kinds KIND ...] [--duration S] [--workers N] [--again]
                                  [--out docs/results]

A factorial experiment: on each random validation road, two random combinations of the habits of `yield-rule`
and their complements are driven, so that each habit is on in two drives of four. Beside them stand the car
alone, the rule as it ships, and SUMO's drivers. Rows are kept in docs/results/data/yielding.csv.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from benchmarks.drives import Case, measure
from benchmarks.full_roads import EACH, KINDS, LARGEST, FullRoad, full_roads
from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.report.statistics import NA, Array, Figure, mean, paired_change
from cosim.seeding import generator

RESULTS = Path("docs/results")
PAGE, DATA = "yielding.md", "data/yielding.csv"
RULE = "policy.agents.yield_rule"
HABITS = {  # what an AV does, and the constant that turns it on
    "eases off for signals": "EASES_OFF",
    "yields at lines": "YIELDS_AT_LINES",
    "makes way": "MAKES_WAY",
    "arrives gently": "ARRIVES_GENTLY",
    "overtakes": "OVERTAKES",
}
CAR, SHIPPED = "the car alone", "`yield-rule`"
DRIVERS: dict[str, dict[str, object]] = {
    CAR: {"policy": "car-alone"},
    SHIPPED: {"policy": "yield-rule"},
    "`idm`": {"policy": "idm"},
    "`idm-courteous`": {"policy": "idm-courteous"},
    "no AVs": {"policy": "idm", "penetration": 0.0},
}
LETTERS = "abcde"  # of the habits
ALL = "all"
# Roads for an answer: the delay of one road changes by a third from drive to drive.
FEWEST = EACH * len(KINDS)


class Drive(NamedTuple):
    """A row of the CSV."""

    driver: str  # of `DRIVERS`, or the letters of the habits that are on
    kind: str  # of road
    seed: int  # of the road and of its traffic
    total_delay_s: float
    total_delay_hv_s: float
    av_involved_collisions: float
    hard_brakings_av: float


def combinations(seed: int) -> Iterator[str]:
    """The letters (a to e) of the habits that are on: two different combinations and their complements."""
    half = 2 ** (len(LETTERS) - 1)
    for number in generator(seed, "yielding").choice(half, 2, replace=False).tolist():
        for bits in (number, 2 * half - 1 - number):
            yield "".join(letter for k, letter in enumerate(LETTERS) if bits >> k & 1) or "-"


def case(driver: str, road: FullRoad, duration: float | None) -> Case:
    """One episode; `duration`: s, None: to its end."""
    options: dict[str, Any] = {"penetration": 0.2, "behavior": "moderate", "errors": "field", "svo_deg": 45.0}
    options |= {"policy": "yield-rule", "what": str(road.folder), "seed": road.seed, "duration": duration}
    options |= DRIVERS.get(driver, {})
    on = {} if driver in DRIVERS else dict(zip(LETTERS, HABITS.values(), strict=True))
    constants = {f"{RULE}.{name}": letter in driver for letter, name in on.items()}
    return Case((driver, road.kind, road.seed), options, constants)


def effects(rows: Sequence[Drive]) -> dict[str, Figure]:
    """The relative change of everybody's delay by each habit, {letter: change}.

    Least squares on logarithms, with an effect of each road. Intervals are of the jackknife over roads.
    """
    of: dict[int, list[Drive]] = {}
    for row in rows:
        if row.driver not in DRIVERS:
            of.setdefault(row.seed, []).append(row)
    on = [
        np.array([[letter in row.driver for letter in LETTERS] for row in road], float)
        for road in of.values()
    ]
    logs = [np.log([row.total_delay_s for row in road]) for road in of.values()]
    x, y = ([values - values.mean(axis=0) for values in parts] for parts in (on, logs))

    def fit(roads: Sequence[int]) -> Array:
        found = [np.concatenate([parts[k] for k in roads]) for parts in (x, y)]
        return np.linalg.lstsq(*found, rcond=None)[0]

    every = [*range(len(of))]
    if len(every) < 2:
        return dict.fromkeys(LETTERS, NA)
    part = len(every) * fit(every) - (len(every) - 1) * np.array(
        [fit([*every[:k], *every[k + 1 :]]) for k in every]
    )
    figures = [mean(column) for column in part.T]
    return {
        letter: Figure(*(math.expm1(x) for x in (one.value, one.low, one.high)))
        for letter, one in zip(LETTERS, figures, strict=True)
    }


# ---- the page ----


def page(rows: Sequence[Drive]) -> list[str]:
    """Effects by kind of road, then the drivers."""
    roads = Counter(kind for kind, _ in {(row.kind, row.seed) for row in rows})
    groups = {ALL: list(rows)}
    groups |= {k: [row for row in rows if row.kind == k] for k in sorted(roads) if roads[k] >= EACH}
    found = {group: [*effects(of).values()] for group, of in groups.items()}
    table = markdown_head(["", *groups])
    table += [
        markdown_row([habit, *(_percent(found[group][k]) for group in groups)])
        for k, habit in enumerate(HABITS)
    ]
    of_roads = sum(roads.values())
    saves = [habit for habit, one in zip(HABITS, found[ALL], strict=True) if one.high < 0.0]
    costs = [habit for habit, one in zip(HABITS, found[ALL], strict=True) if one.low > 0.0]
    said = [
        f"{' and '.join(names)} {verb} delay" for names, verb in ((saves, "saves"), (costs, "costs")) if names
    ]
    answer = f"**Over all roads** {'; '.join(said) or 'no habit has an effect that is beyond chance'}."
    if of_roads < FEWEST:
        answer = f"**Not decided:** {of_roads} roads are too few."
    return WORDS.format(
        answer=answer,
        effects="\n".join(table),
        drivers="\n".join(_drivers(rows)),
        largest=LARGEST,
        roads=", ".join(f"{count} {kind}" for kind, count in sorted(roads.items())),
        each=max(roads.values(), default=EACH),
        kinds=" ".join(sorted(roads)),
        data=DATA,
    ).splitlines()


def _percent(figure: Figure) -> str:
    return "" if not figure.known else figure.text(0, 100.0) + " %"


def _drivers(rows: Sequence[Drive]) -> Iterator[str]:
    """Each driver beside the car on the same roads."""
    head = ["", "roads", "delay, s", "change", "of humans' delay", "AVs' hard brakings", "AVs' collisions"]
    yield from markdown_head(head)
    car = {row.seed: row for row in rows if row.driver == CAR}
    for driver in DRIVERS:
        of = [row for row in rows if row.driver == driver and row.seed in car]
        if not of:
            continue
        beside = [car[row.seed] for row in of]
        change = ["", ""]
        if driver != CAR:
            columns = ("total_delay_s", "total_delay_hv_s")
            change = [
                _percent(paired_change([getattr(a, c) for a in beside], [getattr(b, c) for b in of]))
                for c in columns
            ]
        hard = "" if driver == "no AVs" else f"{fmean(row.hard_brakings_av for row in of):.0f}"
        hits = "" if driver == "no AVs" else f"{sum(row.av_involved_collisions for row in of):.0f}"
        delay = f"{fmean(row.total_delay_s for row in of):.1f}"
        yield markdown_row([driver, str(len(of)), delay, *change, hard, hits])


WORDS = """# Is there anything to learn beyond the lawful car?

An agent can yield more than the car does by itself, or change lanes, which the car does for its
route alone. Each habit below is a few lines of [`yield-rule`](../reference/presets.md#policies),
with constants set by hand. No vehicle is marked. On each road the same traffic meets AVs with and
without the habit, in random combinations with the others.

{answer}

## Change of everybody's delay by each habit

{effects}

Least squares on logarithms with an effect of each road; brackets hold 95 % intervals over roads.

## Drivers on the same roads

{drivers}

Changes are relative to the car alone.

## Conditions

Random roads of the validation seeds whose demand is at least their nominal capacity, and at most
{largest:,.0f} vehicles/h ([formats](../reference/formats.md)): {roads}. Drivers
`moderate`, errors `field`, 20 % AVs, phi 45, sensing `ideal`. Rows:
[{data}]({data}).

```
python -m benchmarks.yielding --each {each} --kinds {kinds}
```
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive what is missing, keep, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--each", type=int, default=EACH, metavar="N", help="roads of a kind")
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS, metavar="KIND")
    parser.add_argument("--duration", type=float, metavar="S", help="for a folder of its own")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--again", action="store_true", help="also what is measured")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FOLDER")
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        roads = [*full_roads(args.each, Path(folder), args.kinds)]
        drivers = [(road, driver) for road in roads for driver in (*DRIVERS, *combinations(road.seed))]
        cases = [case(driver, road, args.duration) for road, driver in drivers]
        rows = measure(Drive, cases, args.workers, args.out / DATA, args.again)
    write_page(args.out / PAGE, page(rows))
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
