"""The plots of the report, with one row per series: rates, distances, times to collision, Pareto, vetoes.

matplotlib's SVG is adapted to the page: colours of the page's theme, its fonts, unique ids.
"""

import hashlib
import io
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cosim.report import statistics, wording
from cosim.report.html.blocks import Block, Series

CRITICAL_TTC = 1.5  # s, bound of a serious conflict (cosim.metrics.time_to_collision)
TTC_HORIZON = 10.0  # s; a longer one is NA
BIN_S = 0.5
WIDTH_INCHES = 5.6  # an inch is 72 px on the page, so a phone shows letters almost full size

# Stand-ins for the page's variables, which differ in light and dark: matplotlib needs fixed colours.
INK, FAINT, GRID = "#010101", "#020202", "#030303"
SERIES = tuple(f"#0400{k:02x}" for k in range(1, 9))
_THEME = {
    INK: "var(--ink)",
    FAINT: "var(--faint)",
    GRID: "var(--line)",
    **{stand_in: f"var(--series-{k})" for k, stand_in in enumerate(SERIES, 1)},
}
_STYLE: Any = {
    "svg.fonttype": "none",  # text can be read and searched, and has the page's font
    "svg.hashsalt": "cosim",  # equal rows, equal file
    "font.size": 9.0,
    "font.family": "sans-serif",
    "text.color": INK,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": FAINT,
    "axes.labelsize": 8.5,
    "xtick.color": FAINT,
    "ytick.color": INK,
    "xtick.labelsize": 8.5,
    "axes.grid": True,
    "axes.grid.axis": "x",
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "ytick.major.size": 0.0,
    "xtick.major.size": 0.0,
}


@dataclass(frozen=True, slots=True)
class Plot:
    """A drawing with its title."""

    title: str
    svg: Markup
    note: str  # explanation of the marks


def plots(block: Block) -> list[Plot]:
    """The plots of a block that have data."""
    series = [s for s in block.series if s.ok]
    share = ("% of episodes", "Point: share; bar: Wilson's 95 % interval; beside it the counts.")
    mean = ("% of decisions", "Point: mean over episodes; bar: bootstrap 95 % interval.")
    with rc_context(_STYLE):
        found = (
            _figures(series, "collision_rate", "Episodes with a collision", *share),
            _figures(
                series,
                "av_caused_collision_rate",
                "Episodes with a collision that an AV caused",
                *share,
            ),
            _figures(series, "mission_success_rate", "Missions fulfilled", *share),
            _spread(series, "dt_mission_m", "Distance of the mission vehicle", "m"),
            _spread(series, "dt_av_m", "Distance of the AVs", "m"),
            _times(series),
            _pareto(series),
            _figures(series, "veto_rate", "Decisions vetoed by the safety mask", *mean),
        )
    return [plot for plot in found if plot is not None]


def _figures(series: list[Series], name: str, title: str, label: str, note: str) -> Plot | None:
    """Shares or means of shares, in per cent with their intervals."""
    figures = {id(s): s.counts(name) for s in series}
    if not any(f.get("n") for f in figures.values()):
        return None

    def draw(axes: Axes, place: float, one: Series) -> str:
        f, colour = figures[id(one)], _colour(one)
        if not f.get("n"):
            return "NA"
        value, low, high = (100 * (f["value"] if f[k] is None else f[k]) for k in ("value", "low", "high"))
        if f["n"] >= wording.SEVERAL:
            style: Any = {"linewidth": 2.5, "alpha": 0.55, "solid_capstyle": "round"}
            axes.plot([low, high], [place, place], color=colour, **style)
        axes.plot([value], [place], "o", markersize=6.5, color=colour, clip_on=False, zorder=3)
        return f"n {f['n']}" if f.get("hits") is None else f"{f['hits']}/{f['n']}"

    return Plot(title, _rows(series, title, label, draw, limits=(0.0, None)), note)


def _spread(series: list[Series], name: str, title: str, unit: str) -> Plot | None:
    """Every episode as a dot, with quartiles."""
    if all(math.isnan(v) for s in series for v in s.values(name)):
        return None

    def draw(axes: Axes, place: float, one: Series) -> str:
        values = np.array([v for v in one.values(name) if not math.isnan(v)])  # [n]
        if not len(values):
            return "NA"
        jitter = np.random.default_rng(0).uniform(-0.22, 0.22, len(values))
        colour = _colour(one)
        axes.scatter(values, place + jitter, s=7, color=colour, alpha=0.35, linewidths=0)
        low, middle, high = np.percentile(values, [25, 50, 75])
        axes.plot([low, high], [place, place], color=colour, linewidth=3.0, solid_capstyle="round")
        axes.plot([middle], [place], "o", markersize=6, color=colour, markeredgecolor=INK)
        return f"n {len(values)}"

    return Plot(title, _rows(series, title, unit, draw), "Dots: episodes; bar: middle half; point: median.")


def _times(series: list[Series]) -> Plot | None:
    """Histograms of the smallest time to collision, a row each."""
    name, title = "min_ttc_s", "Smallest time to collision in each episode"
    if not any(s.values(name) for s in series):
        return None
    edges = np.arange(0.0, TTC_HORIZON + BIN_S / 2, BIN_S)  # [k+1] s
    shares = {
        id(s): np.histogram([v for v in s.values(name) if not math.isnan(v)], edges)[0] / len(s.ok)
        for s in series
    }  # [k] of the series' episodes
    tallest = max(float(share.max()) for share in shares.values()) or 1.0

    def draw(axes: Axes, place: float, one: Series) -> str:
        heights = -0.8 * shares[id(one)] / tallest  # rows are counted downwards
        axes.bar(edges[:-1], heights, 0.92 * BIN_S, place + 0.4, align="edge", color=_colour(one))
        missing = sum(math.isnan(v) for v in one.values(name))
        return f"n {len(one.ok) - missing}" + (f", {missing} none" if missing else "")

    note = (
        f"Share of episodes; line: {CRITICAL_TTC:g} s, critical; none: no vehicle within {TTC_HORIZON:g} s."
    )
    return Plot(title, _rows(series, title, "s", draw, limits=(0.0, TTC_HORIZON), mark=CRITICAL_TTC), note)


def _pareto(series: list[Series]) -> Plot | None:
    """Distance of AVs against that of the mission vehicle, or of human drivers; an SVO sweep is a line."""
    others = {"dt_mission_m": "mission vehicle", "dt_hv_m": "human drivers"}
    name = next((n for n in others if any(s.counts(n).get("n") for s in series)), "dt_hv_m")
    beneficiary = others[name]
    points = [(s, statistics.mean(s.values("dt_av_m")), statistics.mean(s.values(name))) for s in series]
    points = [(s, x, y) for s, x, y in points if x.known and y.known]
    if len(points) < 2:
        return None
    figure, axes = _canvas(7.0)
    axes.grid(axis="y")
    for policy in dict.fromkeys(s.identity["policy"] for s, _, _ in points):
        sweep = [p for p in points if p[0].identity["policy"] == policy]
        sweep.sort(key=lambda p: p[0].identity["svo_deg"] or 0.0)
        colour = _colour(sweep[0][0])
        axes.plot([x.value for _, x, _ in sweep], [y.value for _, _, y in sweep], color=colour, linewidth=1.0)
        for _, x, y in sweep:
            axes.plot((x.low, x.high), (y.value, y.value), color=colour, linewidth=1.6, alpha=0.5)
            axes.plot((x.value, x.value), (y.low, y.high), color=colour, linewidth=1.6, alpha=0.5)
            axes.plot([x.value], [y.value], "o", markersize=6, color=colour)
    axes.set_xlabel("mean distance of the AVs, m")
    axes.set_ylabel(f"mean distance of the {beneficiary}, m")
    axes.tick_params(axis="y", colors=FAINT, labelsize=8.5)
    axes.margins(0.15)
    _name_points(axes, [(one.label, x.value, y.value) for one, x, y in points])
    title = f"Distance of AVs and of the {beneficiary}"
    return Plot(title, _render(figure, title), "Up and to the right is better for all; bars: 95 % intervals.")


# ---- inside ----


def _rows(
    series: list[Series],
    title: str,
    label: str,
    draw: Callable[[Axes, float, Series], str],
    *,
    limits: tuple[float | None, float | None] = (None, None),
    mark: float | None = None,
) -> Markup:
    """A drawing with a row per series, the first on top; `draw` returns the text at the row's right end."""
    figure, axes = _canvas(len(series))
    if mark is not None:
        axes.axvline(mark, color=FAINT, linewidth=1.0, linestyle=(0, (4, 3)))
    texts = [draw(axes, float(k), one) for k, one in enumerate(series)]
    axes.set_yticks(range(len(series)), [s.label for s in series])
    axes.tick_params(axis="y", pad=9)
    axes.set_ylim(len(series) - 0.45, -0.55)
    axes.set_xlim(*limits)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlabel(label)
    right = axes.twinx()
    right.set_ylim(*axes.get_ylim())
    right.set_yticks(range(len(series)), texts)
    right.tick_params(axis="y", colors=FAINT, labelsize=8.0, length=0)
    right.grid(visible=False)
    right.spines[:].set_visible(False)
    return _render(figure, title)


def _name_points(axes: Axes, points: list[tuple[str, float, float]]) -> None:
    """Write each name beside its point, at another corner where earlier names are close."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    taken: list[tuple[float, float]] = []  # shares of the drawing's width and height
    for label, x, y in sorted(points, key=lambda p: p[1]):
        place = ((x - left) / (right - left), (y - bottom) / (top - bottom))
        crowded = sum(abs(place[0] - u) < 0.25 and abs(place[1] - v) < 0.07 for u, v in taken)
        offset = ((6, 6), (6, -13), (-6, 6), (-6, -13))[crowded % 4]
        side = "left" if offset[0] > 0 else "right"
        style: Any = {"textcoords": "offset points", "fontsize": 8.5, "color": INK}
        axes.annotate(label, (x, y), offset, horizontalalignment=side, **style)
        taken.append(place)


def _colour(one: Series) -> str:
    return SERIES[one.colour % len(SERIES)]


def _canvas(rows: float) -> tuple[Figure, Axes]:
    """An empty drawing with room for `rows` rows of a series each."""
    figure = Figure(figsize=(WIDTH_INCHES, 0.55 + 0.36 * rows), layout="constrained")
    return figure, figure.add_subplot()


def _render(figure: Figure, title: str) -> Markup:
    """The drawing as one `<svg>` element, safe to put into the page."""
    raw = io.StringIO()
    figure.savefig(raw, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = re.sub(r"<metadata>.*?</metadata>", "", raw.getvalue(), flags=re.DOTALL)
    for stand_in, variable in _THEME.items():
        text = text.replace(stand_in, variable)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    prefix = f"d{hashlib.sha256(text.encode()).hexdigest()[:8]}-"
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{prefix}", text)
    opening, rest = text[text.index("<svg") :].split(">", 1)
    box = opening[opening.index("viewBox") :]
    box = box[: box.index('"', len('viewBox="')) + 1]
    start = f'<svg xmlns="http://www.w3.org/2000/svg" {box} role="img"><title>{Markup.escape(title)}</title>'
    return Markup(start + rest)
