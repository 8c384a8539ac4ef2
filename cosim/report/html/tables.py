"""The tables of the report, as plain cells: text, sort key, and small lines with interval and counts."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from cosim.report import wording
from cosim.report.changes import tone
from cosim.report.compare import PairedFigure
from cosim.report.figures import CRASH_RATES, HEADLINE, NEAR_MISS_RATES, Measure
from cosim.report.html.blocks import Block, Difference, Series
from cosim.report.result import EVERYBODY, LAW, NEAR_MISSES
from cosim.report.statistics import Figure
from cosim.report.summary import GROUP

TITLES = {
    "scenario": "scenario",
    "demand": "demand",
    "policy": "policy",
    "behavior": "behaviour",
    "penetration": "penetration",
    "preset": "preset",
    "errors": "human errors",
    "sensing": "sensing",
    "svo_deg": "SVO",
    "driver_model": "drivers",
    "collision_rate": "collisions",
    "av_caused_collision_rate": "AV-caused",
    "mission_success_rate": "mission",
    "dt_mission_m": "mission vehicle",
    "dt_av_m": "AVs",
    "dt_mean_m": "all",
    "min_ttc_s": "min TTC",
    "hard_brakings_av": "hard brakings of AVs",
    "veto_rate": "vetoes",
    **EVERYBODY,
    **LAW,
    "av_trips_completed": "AV trips completed",
    **dict(zip(CRASH_RATES, ("with an AV", "AV-caused", "all crashes"), strict=True)),
    **{
        m.name: what
        for kind, what in NEAR_MISSES.items()
        for m in NEAR_MISS_RATES.values()
        if m.column.endswith(kind)
    },
}


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table."""

    text: str
    sort: str  # sort key
    small: tuple[str, ...] = ()  # interval and counts, a line each
    tone: str = ""  # "good", "bad", "warn" or ""


@dataclass(frozen=True, slots=True)
class Table:
    """Heads and rows; `common`: values that all rows share."""

    heads: list[str]
    rows: list[list[Cell]]
    common: list[str]


def figures(blocks: Sequence[Block], known: dict[str, Measure]) -> Table:
    """One row per cell of the run with its headline figures."""
    series, varying = _series(blocks)
    names = [n for n in HEADLINE if n in known]
    rows = [
        [_named(s, varying), _episodes(s), *(_figure(s.counts(n), known[n]) for n in names)] for s in series
    ]
    heads = ["policy", "episodes", *(head(known[n]) for n in names)]
    common = [
        f"{TITLES[n]} {_plain(series[0].identity[n])}{'°' * (n == 'svo_deg')}"
        for n in GROUP
        if series and n != "policy" and n not in varying and series[0].identity[n] is not None
    ]
    return Table(heads, rows, common)


def law(blocks: Sequence[Block], known: dict[str, Measure]) -> Table | None:
    """One row per cell with its AVs' violations, red if not 0; None if no episode counts violations."""
    series, varying = _series(blocks)
    names = [n for n in LAW if any(s.counts(n).get("n") for s in series)]
    if not names:
        return None
    more = [n for n in ("interventions", "av_trips_completed") if n in known]
    rows = [
        [
            _named(s, varying),
            *(_red_unless_0(_figure(s.counts(n), known[n]), s.counts(n)) for n in names),
            *(_figure(s.counts(n), known[n]) for n in more),
        ]
        for s in series
    ]
    return Table(["policy", *(head(known[n]) for n in (*names, *more))], rows, [])


def chosen(blocks: Sequence[Block], known: dict[str, Measure], which: Iterable[str]) -> Table | None:
    """One row per cell with the figures `which`; None if no episode has one of them."""
    series, varying = _series(blocks)
    names = [n for n in which if any(s.counts(n).get("n") for s in series)]
    if not names:
        return None
    rows = [[_named(s, varying), *(_figure(s.counts(n), known[n]) for n in names)] for s in series]
    return Table(["policy", *(head(known[n]) for n in names)], rows, [])


def differences(against_baseline: Iterable[Difference]) -> Table | None:
    """Series of a block against its baseline, pair by pair, where any figure applies; None without any."""
    found = [d for d in against_baseline if any(f.n for f in d.figures.values())]
    measures = found[0].figures if found else {}
    shown = [n for n in measures if any(d.figures[n].n for d in found)]
    if not shown:
        return None
    rows = [
        [
            Cell(d.series.label, d.series.label, (f"against {d.baseline.label}",)),
            Cell(str(d.pairs), str(d.pairs)),
            *(_difference(d.figures[n]) for n in shown),
        ]
        for d in found
    ]
    return Table(["policy", "pairs", *(head(measures[n].measure) for n in shown)], rows, [])


def everything(block: Block) -> Table:
    """Every figure of every series of a block: measures down, series across."""
    rows = [
        [
            Cell(name, name, (measure.unit,) if measure.unit else ()),
            *(_figure(s.counts(name), measure) for s in block.series),
        ]
        for name, measure in block.series[0].known.items()
    ]
    return Table(["figure", *(s.label for s in block.series)], rows, [])


def head(measure: Measure) -> str:
    """The short name of a measure, the unit of an incidence, and the better direction."""
    arrow = {"higher": "\N{NO-BREAK SPACE}↑", "lower": "\N{NO-BREAK SPACE}↓"}.get(measure.better, "")
    unit = f" {measure.unit}" * bool(measure.per)
    return TITLES.get(measure.name, measure.name) + unit + arrow


# ---- inside ----


def _series(blocks: Sequence[Block]) -> tuple[list[Series], list[str]]:
    """The series of all blocks, and the columns of `GROUP` in which they differ."""
    series = [s for block in blocks for s in block.series]
    return series, [n for n in GROUP if len({s.identity[n] for s in series}) > 1]


def _red_unless_0(cell: Cell, counts: dict[str, Any]) -> Cell:
    return replace(cell, tone="bad") if counts.get("value") else cell


def _named(series: Series, varying: Sequence[str]) -> Cell:
    """Policy and SVO, and below them the other options that distinguish the cell."""
    identity = series.identity
    text = str(identity["policy"])
    if "svo_deg" in varying and identity["svo_deg"] is not None:
        text += f" {identity['svo_deg']:g}°"
    others = [_plain(identity[n]) for n in varying if n not in ("policy", "svo_deg")]
    label = f"({identity['policy_label']})" if identity["policy_label"] else ""
    small = tuple(filter(None, (" / ".join(others), label)))
    return Cell(text, " ".join((*others, text)), small)


def _plain(value: Any) -> str:
    return "–" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _episodes(series: Series) -> Cell:
    ok, total = len(series.ok), len(series.rows)
    others = [f"{count} {name}" for name, count in series.figures["status"].items() if count and name != "ok"]
    unfit = series.figures["not_comparable"]
    small = (*others, *([f"{unfit} not comparable"] if unfit else []))
    text = str(ok) if ok == total else f"{ok} of {total}"
    return Cell(text, str(ok), small, "bad" if ok < total else "warn" if unfit else "")


def _figure(counts: dict[str, Any], measure: Measure) -> Cell:
    """The value, and below it interval and counts."""
    measure = _without_unit(measure)
    n, na = counts.get("n", 0), counts.get("na", 0)
    if not n:
        return Cell(wording.NA_TEXT, "", (f"{na} NA",) if na else ())
    value, low, high = (math.nan if counts[k] is None else counts[k] for k in ("value", "low", "high"))
    text, bounds = wording.value_and_bounds(Figure(value, low, high), measure, n=n)
    if (counts.get("rule_of_three") or 1.0) < 1.0:
        bounds = f"below {100 * counts['rule_of_three']:.3g} % (3/n)"
    elif value and low == high and n >= wording.SEVERAL and counts.get("hits") is None:
        bounds = "all equal"
    return Cell(text, repr(value), tuple(filter(None, (bounds, wording.sample(counts)))))


def _difference(figure: PairedFigure) -> Cell:
    if not figure.n:
        return Cell(wording.NA_TEXT, "")
    n = figure.n
    text, bounds = wording.value_and_bounds(
        figure.difference, _without_unit(figure.measure), signed=True, n=n
    )
    p = "" if figure.p is None or n < wording.SEVERAL else wording.p_value(figure.p)
    pairs = f"{n} pairs" if figure.na else ""
    small = tuple(filter(None, (bounds, ", ".join(filter(None, (p, pairs))))))
    return Cell(text, repr(figure.difference.value), small, tone(figure))


def _without_unit(measure: Measure) -> Measure:
    """The measure for cells; the unit of an incidence is in the head of the column."""
    return replace(measure, unit="") if measure.per else measure
