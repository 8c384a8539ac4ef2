"""Is there anything to learn? Scripted yielding beside the lawful car, on random roads that are full.

    python -m benchmarks.yielding [--each N] [--rules NAME ...] [--duration S] [--workers N] [--again]
                                  [--out docs/results]

Each rule is `yield-rule` with some of its constants changed. All drive the same random validation roads.
Rows are kept in docs/results/data/yielding.csv; the page is made of them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from benchmarks.drives import Case, measure
from benchmarks.full_roads import EACH, KINDS, FullRoad, full_roads
from benchmarks.tables import markdown_row, write_page
from cosim.report.statistics import paired_change
from sumo_scenarios.roads import NAMED

RESULTS = Path("docs/results")
PAGE, DATA = "yielding.md", "data/yielding.csv"
RULE = "policy.agents.yield_rule"
CAR = "the car"
NEVER = float("inf")
RULES: dict[str, dict[str, object]] = {
    "as it ships": {},
    "2 m/s slower": {"EASE": 2.0},
    "8 m/s slower": {"EASE": 8.0},
    "for 15 s": {"HOLD": 15.0, "REST": 0.0},
    "for vehicles above 10 m/s": {"LEAST_SPEED": 10.0},
    "above 10 m/s, two between": {"LEAST_SPEED": 10.0, "MAX_BETWEEN": 2, "GAPS": (2.0, 80.0)},
    "above 10 m/s, 8 m/s slower": {"LEAST_SPEED": 10.0, "EASE": 8.0},
    "signals alone": {"PATIENCE": NEVER},
    "lines after 15 s": {"PATIENCE": 15.0},
}
DRIVERS: dict[str, dict[str, Any]] = {
    CAR: {"policy": "car-alone"},
    **{rule: {"policy": "yield-rule"} for rule in RULES},
}


class Drive(NamedTuple):
    """A row of the CSV."""

    driver: str
    kind: str  # of road
    seed: int  # of the road and of its traffic
    total_delay_s: float
    total_delay_hv_s: float
    av_involved_collisions: float
    hard_brakings_av: float


def case(driver: str, road: FullRoad, duration: float | None) -> Case:
    """One episode; `duration`: s, None: to its end."""
    options: dict[str, Any] = {"penetration": 0.2, "behavior": "moderate", "errors": "field", "svo_deg": 45.0}
    options |= {**DRIVERS[driver], "what": str(road.folder), "seed": road.seed, "duration": duration}
    constants = {f"{RULE}.{name}": value for name, value in RULES.get(driver, {}).items()}
    return Case((driver, road.kind, road.seed), options, constants)


def page(rows: Sequence[Drive]) -> list[str]:
    """The page: each rule beside the car, by kind of road."""
    of = {(row.driver, row.kind, row.seed): row for row in rows}
    lines = [markdown_row(TABLE), "|---" * len(TABLE) + "|"]
    for kind in ("all", *dict.fromkeys(row.kind for row in rows)):
        for driver in DRIVERS:
            lines += _lines(of, kind, driver)
    count = len({row.seed for row in rows if row.driver == CAR})
    return WORDS.format(table="\n".join(lines), count=count, each=count // len(NAMED), data=DATA).splitlines()


TABLE = ["roads", "pairs", "driver", "delay of everybody, s", "change", "change of humans'", "hard brakings"]


def _lines(of: dict[tuple[str, str, int], Drive], kind: str, driver: str) -> Iterator[str]:
    """One driver's line on roads of one kind ("all": of every kind)."""
    pairs = [
        (of[CAR, k, seed], row)
        for (d, k, seed), row in of.items()
        if d == driver and kind in ("all", k) and (CAR, k, seed) in of
    ]
    if not pairs:
        return
    before, after = (list(side) for side in zip(*pairs, strict=True))
    changes = ["", ""]
    if driver != CAR:
        for k, column in enumerate(("total_delay_s", "total_delay_hv_s")):
            old, new = ([getattr(row, column) for row in side] for side in (before, after))
            changes[k] = paired_change(old, new).text(0, 100.0) + " %"
    delay, brakings = fmean(a.total_delay_s for a in after), fmean(a.hard_brakings_av for a in after)
    yield markdown_row([kind, str(len(pairs)), driver, f"{delay:.1f}", *changes, f"{brakings:.0f}"])


WORDS = """# Is there anything to learn beyond the lawful car?

`yield-rule` eases off for a vehicle that signals onto the AV's lane, and for one that has long
waited at a line. No vehicle is marked. Each row changes some of the rule's constants. Change is
relative to the lawful car alone on the same roads, with 95 % intervals over roads.

{table}

## Conditions

{count} random roads of the validation seeds, equally many of each kind, whose demand is at least
their nominal capacity ([formats](../reference/formats.md)), drivers `moderate`, errors `field`,
20 % AVs, phi 45, sensing `ideal`. Rows: [{data}]({data}).

```
python -m benchmarks.yielding --each {each}
```
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive what is missing, keep, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--each", type=int, default=EACH, metavar="N", help="roads of a kind")
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS, metavar="KIND")
    parser.add_argument("--rules", nargs="*", default=[*RULES], choices=[*RULES], metavar="NAME")
    parser.add_argument("--duration", type=float, metavar="S", help="for a folder of its own")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--again", action="store_true", help="also what is measured")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FOLDER")
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        roads = [*full_roads(args.each, Path(folder), args.kinds)]
        cases = [case(driver, road, args.duration) for road in roads for driver in (CAR, *args.rules)]
        rows = measure(Drive, cases, args.workers, args.out / DATA, args.again)
    write_page(args.out / PAGE, page(rows))
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
