"""Figures of arms as Markdown tables, as CSV and as a picture: what the result pages are made of."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure as Picture

from benchmarks.arms import of_world
from cosim.files import whole
from cosim.report import wording
from cosim.report.compare import Compared, PairedFigure
from cosim.report.figures import Measure, Row
from cosim.report.run_folder import Run
from cosim.report.statistics import NA, Figure
from cosim.report.summary import incidence_document, mean_document, not_comparable, rate_document
from cosim.workers.tasks import OK

HEADS = {
    "collision_rate": "C%",
    "av_caused_collision_rate": "AV-caused",
    "mission_success_rate": "mission success",
    "dt_mean_m": "DT all",
    "dt_av_m": "DT AVs",
    "dt_hv_m": "DT HVs",
    "dt_mission_m": "DT mission vehicle",
    "hard_brakings_av": "hard brakings of AVs",
    "veto_rate": "vetoed",
    "fallback_rate": "no safe action",
}
COLUMNS = tuple(name for name in HEADS if name != "fallback_rate")
DPI = 110


class Line(NamedTuple):
    """One figure, a line of the CSV. Shares and their differences are fractions."""

    demand: str
    scenario: str
    arm: str
    against: str  # the arm it is a paired difference to; "" for a figure of its own
    figure: str
    unit: str
    value: float
    low: float
    high: float
    n: int  # episodes, or pairs
    na: int
    p: float | None  # exact McNemar, of a difference of shares


def found(rows: Sequence[Row], measure: Measure) -> tuple[Figure, dict[str, Any]]:
    """A measure over the episodes that came through, and its counts: `n`, `na`, `hits` of a rate."""
    ok = [row for row in rows if row["status"] == OK]
    document = rate_document if measure.is_rate else incidence_document if measure.per else mean_document
    counts = document(measure, ok)
    bounds = (counts[name] for name in ("value", "low", "high"))
    return Figure(*(math.nan if x is None else x for x in bounds)), counts


def table(world: str, runs: Mapping[str, Run], columns: Sequence[str] = COLUMNS) -> list[str]:
    """One world: a line per arm, a column per figure; columns that apply to nobody are left out."""
    cells: dict[str, dict[str, str]] = {}
    for name, run in runs.items():
        rows = of_world(run, world)
        cells[name] = {}
        for column in columns:
            if column in run.measures:
                measure = run.measures[column]
                figure, counts = found(rows, measure)
                hits = f", {counts['hits']}/{counts['n']}" if measure.is_rate and counts["n"] else ""
                cells[name][column] = wording.interval(figure, measure) + hits if figure.known else "-"
        wrong = sum(row["status"] != OK for row in rows)
        cells[name]["other"] = f"{sum(map(not_comparable, rows))}" + (f", {wrong} failed" if wrong else "")
    shown = [c for c in columns if any(line.get(c, "-") != "-" for line in cells.values())]
    return [
        markdown_row(["", *(HEADS.get(c, c) for c in shown), "not comparable"]),
        "|---" * (len(shown) + 2) + "|",
        *(
            markdown_row([name, *(line.get(c, "-") for c in shown), line["other"]])
            for name, line in cells.items()
        ),
        "",
    ]


def difference_table(
    compared: Mapping[str, Compared], figures: Sequence[str], *, arms_down: bool = False
) -> list[str]:
    """One world: a line per figure, a column per arm that the differences are to, or the other way round.

    Figures that apply to nobody are left out.
    """
    cells = {
        name: {arm: _difference(pairs.figures.get(name)) for arm, pairs in compared.items()}
        for name in figures
    }
    shown = {HEADS.get(n, n): of_arm for n, of_arm in cells.items() if set(of_arm.values()) - {"-"}}
    if arms_down:
        shown = {arm: {name: of_arm[arm] for name, of_arm in shown.items()} for arm in compared}
    heads = list(next(iter(shown.values()), compared))
    lines = [markdown_row(["", *heads]), "|---" * (len(heads) + 1) + "|"]
    return [*lines, *(markdown_row([name, *line.values()]) for name, line in shown.items()), ""]


def markdown_row(cells: Sequence[str]) -> str:
    """`| a | b |`"""
    return f"| {' | '.join(cells)} |"


def lines_of(
    demand: str, worlds: Sequence[str], runs: Mapping[str, Run], columns: Sequence[str]
) -> list[Line]:
    """The figures of every arm for the CSV."""
    out = []
    for world in worlds:
        for name, run in runs.items():
            for column in columns:
                if column not in run.measures:
                    continue
                measure = run.measures[column]
                f, counts = found(of_world(run, world), measure)
                n, na = counts["n"], counts["na"]
                out.append(
                    Line(demand, world, name, "", column, measure.unit, f.value, f.low, f.high, n, na, None)
                )
    return out


def difference_lines(
    demand: str, name: str, against: str, compared: Mapping[str, Compared], figures: Sequence[str]
) -> list[Line]:
    """The paired differences `name` - `against` for the CSV."""
    out = []
    for world, pairs in compared.items():
        for column in figures:
            known = pairs.figures.get(column)
            if known is not None and known.n:
                d, unit = known.difference, known.measure.unit
                out.append(
                    Line(
                        *(demand, world, name, against, column, unit, d.value, d.low, d.high),
                        *(known.n, known.na, known.p),
                    )
                )
    return out


def write_csv(path: Path, lines: Sequence[Line]) -> None:
    """NA is empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Line._fields)
        for line in lines:
            writer.writerow([_plain(value) for value in line])


def picture(
    path: Path, panels: Mapping[str, Mapping[str, Mapping[str, Figure]]], percent: Sequence[str] = ()
) -> None:
    """Panels side by side: title -> arm -> group -> figure, points with their intervals.

    `percent`: titles of the panels that hold shares.
    """
    most = max((len({g for f in arms.values() for g in f}) for arms in panels.values()), default=0)
    crowded = most > 6
    size = (4.2 * len(panels) + 1.8, 5.2 if crowded else 3.8)  # inches, the legend's beside them
    drawn = Picture(figsize=size, layout="constrained")
    every = drawn.subplots(1, len(panels), squeeze=False)[0]
    for axes, (title, arms) in zip(every, panels.items(), strict=True):
        scale = 100.0 if title in percent else 1.0
        groups = list(dict.fromkeys(group for figures in arms.values() for group in figures))
        for k, (name, figures) in enumerate(arms.items()):
            shift = 0.7 * ((k + 0.5) / len(arms) - 0.5)
            shown = [(g, f) for g, f in ((g, figures.get(g, NA)) for g in groups) if f.known]
            x = [groups.index(g) + shift for g, _ in shown]
            y = np.array([f.value for _, f in shown])
            ends = np.array([[f.value - f.low, f.high - f.value] for _, f in shown]).reshape(-1, 2)
            errors = scale * np.nan_to_num(ends).clip(0.0).T
            axes.errorbar(x, scale * y, errors, fmt="o", markersize=4, capsize=2, label=name)
        axes.set_xticks(range(len(groups)), groups, rotation=90 if crowded else 20)
        axes.set(title=title, ylabel="%" if title in percent else "m")
        axes.grid(axis="y", alpha=0.3)
    lines = {name: line for a in every for line, name in zip(*a.get_legend_handles_labels(), strict=True)}
    drawn.legend(lines.values(), lines, loc="outside right upper", fontsize="small")
    drawn.savefig(path, dpi=DPI)


def stacked_bars(path: Path, panels: Mapping[str, Mapping[str, Mapping[str, int]]], label: str) -> None:
    """Panels side by side: title -> bar -> part -> count, from the top down; `label`: of the counts."""
    bars = list(dict.fromkeys(bar for found in panels.values() for bar in found))
    drawn = Picture(figsize=(5.0 * len(panels) + 1.5, 1.6 + 0.26 * len(bars)), layout="constrained")
    every = drawn.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axes, (title, found) in zip(every, panels.items(), strict=True):
        ends = np.zeros(len(bars))
        for part in dict.fromkeys(part for counts in found.values() for part in counts):
            wide = np.array([found.get(bar, {}).get(part, 0) for bar in bars], float)
            axes.barh(bars, wide, left=ends, label=part)
            ends += wide
        axes.set(title=title, xlabel=label)
        axes.grid(axis="x", alpha=0.3)
        axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)
    every[0].invert_yaxis()
    drawn.savefig(path, dpi=DPI)


READ = "read"  # between these marks stands what a person read in the figures


def marks(name: str) -> tuple[str, str]:
    """What stands before and behind a part of a page that is kept, or made anew, by itself."""
    return f"<!-- {name} -->", f"<!-- end of {name} -->"


def marked(text: str, name: str) -> tuple[str, str, str] | None:
    """What stands before the marks of this name, between and behind them; None where they are not there.

    Raises SystemExit where only the first is: what a person wrote behind it is not to be lost.
    """
    begin, end = marks(name)
    before, begun, rest = text.partition(begin)
    between, ended, after = rest.partition(end)
    if begun and not ended:
        raise SystemExit(f"{begin} stands without {end}")
    return (before, between, after) if begun else None


def fill(page: Path, name: str, lines: Sequence[str]) -> None:
    """Put the lines between the page's marks of this name. Raises SystemExit where it has none."""
    begin, end = marks(name)
    parts = marked(page.read_text(encoding="utf-8"), name)
    if parts is None:
        raise SystemExit(f"{page}: no markers {begin} and {end}")
    with whole(page) as draft:
        draft.write_text("\n".join([parts[0] + begin, *lines, end + parts[2]]), encoding="utf-8")


def write_page(path: Path | None, lines: Sequence[str]) -> None:
    """The Markdown page, whole or not at all; printed where there is no path.

    What the page that was there has between the marks of `READ` stays, before the first section; stderr asks
    to read it.
    """
    if path is None:
        print("\n".join(lines))
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    begin, end = marks(READ)
    if path.is_file() and (parts := marked(path.read_text(encoding="utf-8"), READ)):
        first = next((k for k, line in enumerate(lines) if line.startswith("## ")), len(lines))
        lines = [*lines[:first], begin + parts[1] + end, "", *lines[first:]]
        print(f"{path}: does what stands between {begin} and {end} still hold?", file=sys.stderr)
    with whole(path) as draft:
        draft.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _difference(found: PairedFigure | None) -> str:
    if found is None or not found.n:
        return "-"
    text = wording.interval(found.difference, found.measure, signed=True)
    return text if found.p is None else f"{text}, {wording.p_value(found.p)}"


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return "" if value is None else value
