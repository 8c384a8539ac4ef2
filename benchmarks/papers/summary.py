"""docs/results/README.md: what the papers claimed and what was found here, read from the CSV files alone.

    python -m benchmarks.papers.summary        # part of `make results`; drives nothing

A claim whose figures are not there is "not run yet"; no figure of the page is written by hand.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from benchmarks.papers.claims import APPROACHES, MERGING_ALTRUISTIC, MERGING_EGOISTIC, TABLE_3, VFN, VFN_P
from benchmarks.papers.driving import WORLDS, Settings, add_arguments, settings_of
from benchmarks.papers.figure9 import BEHAVIORS
from benchmarks.papers.guide import OVERTAKES, SLOWS, YIELDS
from benchmarks.papers.pages import SAID_FIRST
from benchmarks.tables import write_page
from cosim.learning.bench_predict import LED

NOT_RUN = "not run yet"
UNTRAINED = " **untrained**"


class Read(NamedTuple):
    """A line of `benchmarks.tables.Line` as read back; shares are fractions."""

    demand: str
    scenario: str
    arm: str
    against: str
    figure: str
    value: float
    low: float
    high: float
    n: int

    def text(self, scale: float, digits: int, unit: str = "") -> str:
        """`value unit (low to high), n`; a difference with its sign; said when the network is untrained."""
        sign = "+" if self.against else ""
        shown = [f"{scale * x:{sign}.{digits}f}" for x in (self.value, self.low, self.high)]
        ends = "" if math.isnan(self.low) else f" ({shown[1]} to {shown[2]})"
        return f"{shown[0]}{unit}{ends}, n {self.n}{UNTRAINED if self.untrained else ''}"

    @property
    def untrained(self) -> bool:
        """Whether a network of it has its initial weights."""
        return "untrained" in self.arm + self.against


class Claim(NamedTuple):
    """One claim of a paper, how it is answered from the CSV files, and the page that shows it all."""

    source: str
    claim: str
    page: str
    found: Callable[[Path], str]


class Lines:
    """The figures of one job."""

    def __init__(self, out: Path, job: str) -> None:
        file = out / "data" / f"{job}.csv"
        self._lines = []
        if file.is_file():
            with file.open(newline="", encoding="utf-8") as stream:
                self._lines = [_read(row) for row in csv.DictReader(stream)]

    def get(
        self, figure: str, arm: str, *, scenario: str, demand: str = "", against: str = ""
    ) -> Read | None:
        """The figure of an arm, or its paired difference to another; None when it is not there."""
        for line in self._lines:
            same = line.figure == figure and line.scenario == scenario and demand in ("", line.demand)
            if same and _is(line.arm, arm) and _is(line.against, against) and not math.isnan(line.value):
                return line
        return None


def write(settings: Settings) -> None:
    """README.md in the folder of results."""
    out = settings.out
    page = [
        "# What the papers claimed, and what we found",
        "",
        *SAID_FIRST,
        "",
        "P: Valiente et al., prediction-aware cooperative driving. T: Toghi et al., altruistic maneuver",
        "planning. Both simulate with HighwayEnv, we with SUMO; worlds and demands are ours. The column",
        "`found` is filled from the CSV files in `data/` by `make results`, never by hand. 95 % intervals in",
        'brackets; a rate is "below" a claimed one only where the upper bound is.',
        "",
        "| | claimed | found | page |",
        "|---|---|---|---|",
    ]
    for claim in CLAIMS:
        there = (out / claim.page).is_file()
        link = f"[{claim.page}]({claim.page})" if there else claim.page
        page.append(f"| {claim.source} | {claim.claim} | {claim.found(out)} | {link} |")
    pages = [*out.glob("*.md"), *out.glob("uses*/*.md")]
    others = sorted(str(p.relative_to(out)) for p in pages if p.name != "README.md")
    page += ["", "All pages: " + ", ".join(f"[{name.removesuffix('.md')}]({name})" for name in others) + "."]
    write_page(out / "README.md", page)
    print(out / "README.md")


# ---- how each claim is answered ----


def crashes(out: Path) -> str:
    """P, Table III, the last row."""
    lines = Lines(out, "table3")
    parts, below = [], 0
    for world in WORLDS:
        line = lines.get("collision_rate", VFN_P, scenario=world)
        if line is None:
            parts.append(f"{world} {NOT_RUN}")
            continue
        less = 100.0 * line.high < TABLE_3[world][VFN_P]
        below += less
        parts.append(f"{world} {line.text(100.0, 2, ' %')}{', below' if less else ''}")
    if all(part.endswith(NOT_RUN) for part in parts):
        return NOT_RUN
    return f"{'; '.join(parts)}: below in {below} of {len(WORLDS)} worlds"


def fewest(out: Path) -> str:
    """P, Table III, by column: paired differences to each of the other five."""
    lines = Lines(out, "table3")
    parts = []
    for world in WORLDS:
        pairs = {
            other: lines.get("collision_rate", VFN_P, scenario=world, against=other)
            for other in APPROACHES[:-1]
        }
        if any(line is None for line in pairs.values()):
            continue
        known = {other: line for other, line in pairs.items() if line is not None}
        worse = [other for other, line in known.items() if line.value > 0.0]
        tied = [other for other, line in known.items() if line.value == 0.0]
        label = UNTRAINED if any(line.untrained for line in known.values()) else ""
        if worse:
            parts.append(f"{world}: no, {' and '.join(worse)} fewer{label}")
        else:
            ties = f", tied with {' and '.join(tied)}" if tied else ""
            parts.append(f"{world}: yes{ties}{label}")
    return "; ".join(parts) or NOT_RUN


def prediction_gain(out: Path) -> str:
    """P, Table III: VFN against VFN + P."""
    lines = Lines(out, "table3")
    return _parts(
        (world, lines.get("collision_rate", VFN_P, scenario=world, against=VFN), 100.0, 2, " points")
        for world in WORLDS
    )


def behaviors(out: Path) -> str:
    """P, figure 9."""
    lines = Lines(out, "figure9")
    return _parts(
        (
            b,
            lines.get(
                "collision_rate",
                f"{VFN_P}, {b}",
                scenario="merge",
                demand=f"dense, {b}",
                against=f"{VFN}, {b}",
            ),
            100.0,
            1,
            " points",
        )
        for b in BEHAVIORS
    )


def predictors(out: Path) -> str:
    """P, figure 5, from `cosim bench predict`: the two best of those that do not know the road."""
    rows = [
        r
        for r in _bench(out, "position_error.csv")
        if (r["scenario"], r["behavior"], r["horizon_s"]) == ("all", "all", "mean") and r["predictor"] != LED
    ]
    if len(rows) < 2:
        return NOT_RUN
    best, second = sorted(rows, key=lambda r: float(r["mean_m"]))[:2]
    two = [
        f"{r['predictor']} {float(r['mean_m']):.2f} m ({float(r['ci_low']):.2f} to {float(r['ci_high']):.2f})"
        for r in (best, second)
    ]
    return f"lowest: {two[0]}, then {two[1]}"


def history(out: Path) -> str:
    """P, figure 6, from `cosim bench predict`: the map error with history, relative to that without."""
    for row in _bench(out, "map_gain.csv"):
        if (row["scenario"], row["against"]) == ("all", "hpn-no-history"):
            change, low, high = (100.0 * float(row[f"pre_{end}"]) for end in ("change", "low", "high"))
            return f"{change:+.1f} % ({low:+.1f} to {high:+.1f})"
    return NOT_RUN


def merging(out: Path) -> str:
    """T, figure 5: mean distances."""
    lines = Lines(out, "t_figures")
    return _parts(
        (name, lines.get("dt_mission_m", arm, scenario="merge", demand=T_TRAFFIC), 1.0, 0, " m")
        for name, arm in (("egoistic", "vfn-p-egoistic"), ("altruistic", VFN_P))
    )


def altruism(out: Path) -> str:
    """T, figure 6: altruists less egoists."""
    lines = Lines(out, "t_figures")
    parts = [
        _parts(
            (
                f"{demand.split(',')[0]}: {name}",
                lines.get(figure, VFN_P, scenario="merge", demand=demand, against="vfn-p-egoistic"),
                scale,
                1,
                unit,
            )
            for name, figure, scale, unit in (
                ("crashes", "collision_rate", 100.0, " points"),
                ("distance", "dt_mean_m", 1.0, " m"),
                ("merges", "mission_success_rate", 100.0, " points"),
            )
        )
        for demand in (T_TRAFFIC, "dense, mixed")
    ]
    return "; ".join(part for part in parts if part != NOT_RUN) or NOT_RUN


def samples(out: Path) -> str:
    """T, figure 8: how many episodes of each kind."""
    lines = Lines(out, "t_figure8")
    shares = []
    for arm, demand in ((VFN_P, T_TRAFFIC), ("altruist-rule", "dense, mixed")):
        kinds = _parts(
            (kind, lines.get(kind, arm, scenario="merge", demand=demand), 100.0, 0, " %")
            for kind in (SLOWS, YIELDS, OVERTAKES)
        )
        if kinds != NOT_RUN:
            shares.append(f"{arm}, {demand.split(',')[0]}: {kinds}")
    return "; ".join(shares) or NOT_RUN


def payment(out: Path) -> str:
    """phi 45 against phi 0, all worlds."""
    lines = Lines(out, "phi")
    parts = []
    for world in ("merge", "exit", "roundabout", "intersection"):
        gains = _parts(
            (
                name,
                lines.get(figure, f"{VFN_P}, phi 45", scenario=world, against=f"{VFN_P}, phi 0"),
                1.0,
                0,
                " m",
            )
            for name, figure in (("AVs", "dt_av_m"), ("HVs", "dt_hv_m"), ("mission", "dt_mission_m"))
        )
        if gains != NOT_RUN:
            parts.append(f"{world}: {gains}")
    return "; ".join(parts) or NOT_RUN


T_TRAFFIC = "contested, moderate"
_P3 = ", ".join(f"{world} {TABLE_3[world][VFN_P]}" for world in WORLDS)
CLAIMS = (
    Claim("P, Table III", f"VFN + P crashes in {_P3} % of episodes", "table3.md", crashes),
    Claim("P, Table III", "VFN + P crashes least of the six in every world", "table3.md", fewest),
    Claim("P, Table III", "prediction saves crashes (VFN + P less VFN)", "table3.md", prediction_gain),
    Claim(
        "P, figure 9",
        "it saves few among conservative, many among aggressive and mixed drivers",
        "figure9.md",
        behaviors,
    ),
    Claim(
        "P, figure 5", "the indirect GP has the lowest position error of eight", "prediction.md", predictors
    ),
    Claim("P, figure 6", "history lowers the map error by about 20 %", "prediction_maps.md", history),
    Claim(
        "T, figure 5",
        f"merging vehicle {MERGING_EGOISTIC:g} m among egoists, {MERGING_ALTRUISTIC:g} m among altruists",
        "t_figures.md",
        merging,
    ),
    Claim("T, figure 6", "altruists crash less, all come further, more merge", "t_figures.md", altruism),
    Claim(
        "T, figure 8", "the guide AV slows down, or yields, or yields and overtakes", "t_figure8.md", samples
    ),
    Claim("T, section 6", "some AVs pay, traffic as a whole gains (phi 45 less phi 0)", "phi.md", payment),
)


# ---- inside ----


def _parts(found: Iterable[tuple[str, Read | None, float, int, str]]) -> str:
    """`name value (low to high) unit; ...`, or that nothing of it was run."""
    parts = [f"{name} {line.text(scale, digits, unit)}" for name, line, scale, digits, unit in found if line]
    return "; ".join(parts) or NOT_RUN


def _bench(out: Path, name: str) -> list[dict[str, str]]:
    """The rows of a CSV of `cosim bench predict`; none while it is not there."""
    for file in (out / name, out / "data" / name):
        if file.is_file():
            with file.open(newline="", encoding="utf-8") as stream:
                return list(csv.DictReader(stream))
    return []


def _is(found: str, wanted: str) -> bool:
    """Whether an arm of the tables, with its label or without, is the one that is wanted."""
    return found == wanted or (bool(wanted) and found.startswith(f"{wanted} ("))


def _read(row: dict[str, str]) -> Read:
    return Read(
        *(row["demand"], row["scenario"], row["arm"], row["against"], row["figure"]),
        *(_number(row["value"]), _number(row["low"]), _number(row["high"])),
        int(row["n"]),
    )


def _number(text: str) -> float:
    return float(text) if text else math.nan


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser)
    write(settings_of(parser.parse_args()))
