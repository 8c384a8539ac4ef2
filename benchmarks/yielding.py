"""Is there anything to learn? Scripted yielding beside the lawful car, on random roads that are full.

    python -m benchmarks.yielding [--each N] [--kinds KIND ...] [--rules NAME ...] [--duration S]
                                  [--workers N] [--again] [--out docs/results]

Each rule is `yield-rule` with some of its constants changed. All drive the same random validation roads.
Rows are kept in docs/results/data/yielding.csv; the page is made of them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from benchmarks.drives import Case, measure
from benchmarks.full_roads import EACH, KINDS, LARGEST, FullRoad, full_roads
from benchmarks.tables import markdown_row, write_page
from cosim.report.statistics import Figure, paired_change

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
    "gentle arrival alone, 4 m/s": {"SURPLUS": 4.0, "MAX_BETWEEN": -1, "PATIENCE": NEVER},
    "gentle arrival alone, 2 m/s": {"SURPLUS": 2.0, "MAX_BETWEEN": -1, "PATIENCE": NEVER},
    "both, 4 m/s": {"SURPLUS": 4.0},
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
    options |= {
        "policy": "car-alone" if driver == CAR else "yield-rule",
        "what": str(road.folder),
        "seed": road.seed,
        "duration": duration,
    }
    constants = {f"{RULE}.{name}": value for name, value in RULES.get(driver, {}).items()}
    return Case((driver, road.kind, road.seed), options, constants)


def page(rows: Sequence[Drive]) -> list[str]:
    """The page: each rule beside the car, by kind of road."""
    of = {(row.driver, row.kind, row.seed): row for row in rows}
    roads = Counter(row.kind for row in rows if row.driver == CAR)
    lines = [markdown_row(TABLE), "|---" * len(TABLE) + "|"]
    lines += [line for kind in (ALL, *roads) for rule in RULES for line in _lines(of, kind, rule)]
    said = ", ".join(f"{count} {kind}" for kind, count in roads.items())
    of_roads = {"roads": said, "each": max(roads.values(), default=EACH), "kinds": " ".join(roads)}
    table, answer = "\n".join(lines), _answer(of)
    return WORDS.format(table=table, answer=answer, largest=LARGEST, data=DATA, **of_roads).splitlines()


ALL, DELAY = "all", "total_delay_s"
TABLE = ["roads", "pairs", "rule", "the car's delay, s", "the rule's", "change", "of humans' delay"]
TABLE += ["hard brakings", "of the rule"]


def _answer(of: dict[tuple[str, str, int], Drive]) -> str:
    """Whether any rule saves delay over all roads."""
    saves = [rule for rule in RULES if (pairs := _pairs(of, ALL, rule)) and _change(pairs, DELAY).high < 0.0]
    if saves:
        return f"**Yes:** everybody's delay falls with: {', '.join(saves)}."
    return "**Not shown:** no rule's interval over all roads lies below 0."


def _lines(of: dict[tuple[str, str, int], Drive], kind: str, rule: str) -> Iterator[str]:
    """One rule's line on roads of one kind."""
    pairs = _pairs(of, kind, rule)
    if not pairs:
        return
    means = (f"{fmean(side):.1f}" for side in _columns(pairs, DELAY))
    changes = (_change(pairs, name).text(0, 100.0) + " %" for name in (DELAY, "total_delay_hv_s"))
    hard = (f"{fmean(side):.0f}" for side in _columns(pairs, "hard_brakings_av"))
    yield markdown_row([kind, str(len(pairs)), rule, *means, *changes, *hard])


def _pairs(of: dict[tuple[str, str, int], Drive], kind: str, rule: str) -> list[tuple[Drive, Drive]]:
    """The car's and the rule's drives on the same roads."""
    return [
        (of[CAR, k, seed], row)
        for (driver, k, seed), row in of.items()
        if driver == rule and kind in (ALL, k) and (CAR, k, seed) in of
    ]


def _columns(pairs: Sequence[tuple[Drive, Drive]], name: str) -> tuple[list[float], list[float]]:
    before, after = zip(*((getattr(a, name), getattr(b, name)) for a, b in pairs), strict=True)
    return [*before], [*after]


def _change(pairs: Sequence[tuple[Drive, Drive]], name: str) -> Figure:
    return paired_change(*_columns(pairs, name))


WORDS = """# Is there anything to learn beyond the lawful car?

`yield-rule` eases off for a vehicle that signals onto the AV's lane, and for one that has long
waited at a line. No vehicle is marked. Each row changes some of the rule's constants. With a gentle
arrival the AV is at most so much faster than the traffic ahead. Change is relative to the lawful
car alone on the same roads, with 95 % intervals over roads.

{answer}

{table}

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
