"""Is there anything to learn? A script that yields, beside the lawful car alone, on full random roads.

    python -m benchmarks.yielding [--each N] [--kinds KIND ...] [--duration S] [--workers N] [--again]
                                  [--out docs/results]

On each random validation road the same traffic meets the car alone, `yield-rule` with both of its habits and
with one alone, SUMO's drivers, and no AVs. Rows are kept in docs/results/data/yielding.csv.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from textwrap import fill
from typing import Any, NamedTuple

from benchmarks.drives import Case, measure
from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.report.statistics import Figure, paired_change
from sumo_scenarios.full_roads import EACH, KINDS, LARGEST, FullRoad, full_roads

RESULTS = Path("docs/results")
PAGE, DATA = "yielding.md", "data/yielding.csv"
RULE = "policy.agents.yield_rule"
HABITS = {  # what the rule does, and the constant that turns it on
    "eases off for signals": "EASES_OFF",
    "yields at lines": "YIELDS_AT_LINES",
}
ALONE = {f"{habit} only": constant for habit, constant in HABITS.items()}  # driver -> its only habit
CAR, SHIPPED, SEARCHED = "the car alone", "`yield-rule`", "`altruist`"
DRIVERS: dict[str, dict[str, object]] = {
    CAR: {"policy": "car-alone"},
    SHIPPED: {"policy": "yield-rule"},
    **{driver: {"policy": "yield-rule"} for driver in ALONE},
    SEARCHED: {"policy": str(RESULTS / "trainings/altruist-0")},  # as `cosim train altruist` wrote it
    "`idm`": {"policy": "idm"},
    "`idm-courteous`": {"policy": "idm-courteous"},
    "no AVs": {"policy": "idm", "penetration": 0.0},
}
COLUMNS = 100  # of the page
# Roads for an answer: the delay of one road changes by a third from drive to drive.
FEWEST = EACH * len(KINDS)


class Drive(NamedTuple):
    """A row of the CSV."""

    driver: str  # of `DRIVERS`
    kind: str  # of road
    seed: int  # of the road and of its traffic
    total_delay_s: float
    total_delay_hv_s: float
    av_involved_collisions: float
    hard_brakings_av: float


def case(driver: str, road: FullRoad, duration: float | None) -> Case:
    """One episode; `duration`: s, None: to its end."""
    options: dict[str, Any] = {"penetration": 0.2, "behavior": "moderate", "errors": "field", "svo_deg": 45.0}
    options |= {"what": str(road.folder), "seed": road.seed, "duration": duration, **DRIVERS[driver]}
    constants: dict[str, object] = {}
    if driver in ALONE:
        constants = {f"{RULE}.{constant}": constant == ALONE[driver] for constant in HABITS.values()}
    return Case((driver, road.kind, road.seed), options, constants)


# ---- the page ----


def page(rows: Sequence[Drive]) -> list[str]:
    """The answer, the drivers over all roads that each has driven, then the rule by kind of road."""
    driven = Counter(row.seed for row in rows)
    most = max(driven.values(), default=0)
    rows = [row for row in rows if driven[row.seed] == most]
    roads = Counter(kind for kind, _ in {(row.kind, row.seed) for row in rows})
    rule, searched = ([row for row in rows if row.driver == driver] for driver in (SHIPPED, SEARCHED))
    change = _beside(CAR, rule, rows, "total_delay_s")
    answer = f"`yield-rule` changes everybody's delay by {_percent(change)}"
    if sum(roads.values()) < FEWEST:
        answer = f"**Not decided:** {sum(roads.values())} roads are too few. {answer}"
    elif change.high < 0.0:
        answer = f"**Yes.** {answer}"
    else:
        answer = f"**No gain is shown.** {answer}"
    return WORDS.format(
        answer=fill(f"{answer}, against the car alone.{_costs(rows, sorted(roads))}", COLUMNS),
        searched=fill(_searched(searched, rows), COLUMNS),
        drivers="\n".join(_drivers(rows)),
        kinds_table="\n".join(_kinds(rows, sorted(roads))),
        largest=LARGEST,
        roads=", ".join(f"{count} {kind}" for kind, count in sorted(roads.items())),
        commands="\n".join(_commands(roads)),
        data=DATA,
    ).splitlines()


def _commands(roads: Mapping[str, int]) -> Iterator[str]:
    """What drives these numbers of roads of each kind."""
    for each in sorted({*roads.values()}):
        kinds = sorted(kind for kind, count in roads.items() if count == each)
        yield f"python -m benchmarks.yielding --each {each} --kinds {' '.join(kinds)}"


def _costs(rows: Sequence[Drive], kinds: Sequence[str]) -> str:
    """A sentence on the kinds of road where the rule is shown to cost delay; empty without one."""
    changes = {
        kind: _beside(CAR, [r for r in rows if (r.driver, r.kind) == (SHIPPED, kind)], rows, "total_delay_s")
        for kind in kinds
    }
    costs = [f"{_percent(change)} on `{kind}` roads" for kind, change in changes.items() if change.low > 0.0]
    return f" It costs {' and '.join(costs)}." if costs else ""


def _searched(searched: Sequence[Drive], rows: Sequence[Drive]) -> str:
    """Whether the search has found habits that save more delay than the rule's."""
    change = _beside(SHIPPED, searched, rows, "total_delay_s")
    if not change.known:
        return "`altruist` has not been driven."
    found = "better ones" if change.high < 0.0 else "no better ones"
    return (
        f"[A search](../guides/training.md#search-for-an-altruist) over the rule's habits found {found}: "
        f"`altruist` changes everybody's delay by {_percent(change)}, against `yield-rule`."
    )


def _beside(other: str, of: Sequence[Drive], rows: Sequence[Drive], column: str) -> Figure:
    """The relative change of a mean against another driver on the same roads."""
    others = {row.seed: row for row in rows if row.driver == other}
    pairs = [(others[row.seed], row) for row in of if row.seed in others]
    before, after = ([getattr(pair[k], column) for pair in pairs] for k in (0, 1))
    return paired_change(before, after)


def _percent(figure: Figure) -> str:
    return "" if not figure.known else figure.text(0, 100.0) + " %"


def _drivers(rows: Sequence[Drive]) -> Iterator[str]:
    """Each driver beside the car on the same roads."""
    head = ["", "roads", "delay, s", "change", "of humans' delay", "AVs' hard brakings", "AVs' collisions"]
    yield from markdown_head(head)
    for driver in DRIVERS:
        of = [row for row in rows if row.driver == driver]
        if not of:
            continue
        columns = () if driver == CAR else ("total_delay_s", "total_delay_hv_s")
        change = [_percent(_beside(CAR, of, rows, column)) for column in columns] or ["", ""]
        hard = "" if driver == "no AVs" else f"{fmean(row.hard_brakings_av for row in of):.0f}"
        hits = "" if driver == "no AVs" else f"{sum(row.av_involved_collisions for row in of):.0f}"
        delay = f"{fmean(row.total_delay_s for row in of):.1f}"
        yield markdown_row([driver, str(len(of)), delay, *change, hard, hits])


def _kinds(rows: Sequence[Drive], kinds: Sequence[str]) -> Iterator[str]:
    """The change by the rule on each kind of road."""
    yield from markdown_head(["", "roads", CAR, SHIPPED, "change"])
    for kind in kinds:
        car, rule = ([r for r in rows if (r.driver, r.kind) == (d, kind)] for d in (CAR, SHIPPED))
        delays = [f"{fmean(r.total_delay_s for r in of):.1f} s" if of else "" for of in (car, rule)]
        change = _percent(_beside(CAR, rule, rows, "total_delay_s"))
        yield markdown_row([f"`{kind}`", str(len(rule)), *delays, change])


WORDS = """# Is there anything to learn beyond the lawful car?

The car alone is courteous where vehicles must change lanes. With
[`yield-rule`](../reference/presets.md#policies) one AV slows down gently behind a vehicle that
signals onto its lane. One AV crawls, far before a line where another vehicle has waited.

{answer}

{searched}

## Everybody's mean delay

{drivers}

Changes are relative to the car alone; brackets hold 95 % intervals over roads. Three more habits
are not shown to save delay: making way to another lane, arriving no faster than the traffic ahead,
overtaking.

## By kind of road

{kinds_table}

## Conditions

Random roads of the validation seeds whose demand is at least their nominal capacity, and at most
{largest:,.0f} vehicles/h ([formats](../reference/formats.md)): {roads}. Drivers
`moderate`, errors `field`, 20 % AVs, phi 45, sensing `ideal`. Rows:
[{data}]({data}).

```
{commands}
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
        drivers = [(road, driver) for road in roads for driver in DRIVERS]
        cases = [case(driver, road, args.duration) for road, driver in drivers]
        rows = measure(Drive, cases, args.workers, args.out / DATA, args.again)
    write_page(args.out / PAGE, page(rows))
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
