"""The picture of a page: the primary figure by arm and scenario, or a front of gains against costs."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from cosim.report.figures import Measure
from cosim.report.statistics import Figure
from research.evaluate import Found
from research.schema import Condition

TICKS = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # %
STYLE: Any = {  # equal figures, equal file
    "svg.fonttype": "none",
    "svg.hashsalt": "cosim",
    "font.size": 9.0,
    "font.sans-serif": ["DejaVu Sans"],  # not all that matplotlib knows, in every text
}
CLIP = re.compile(r"\bp[0-9a-f]{10}\b")  # hash of a clip's exact size, whose last bits depend on the machine
FINE = re.compile(r"\b\d+\.\d{3,}\b")  # a coordinate, in hundredths of a point and finer


def draw(found: Found, path: Path) -> None:
    """Write the picture of a claim."""
    save(_front(found) if found.claim.front else _points(found), path)


def save(picture: Picture, path: Path, dpi: float | None = None) -> None:
    """Write the picture as SVG; equal figures give an equal file. `dpi`: of rasterized parts."""
    drawn = io.StringIO()
    with rc_context(STYLE):
        picture.savefig(drawn, format="svg", dpi=dpi or "figure", metadata={"Date": None, "Creator": None})
    numbers: dict[str, str] = {}
    text = CLIP.sub(lambda found: numbers.setdefault(found[0], f"clip{len(numbers)}"), drawn.getvalue())
    text = FINE.sub(lambda found: f"{float(found[0]):.2f}", text)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


# ---- inside ----


def _points(found: Found) -> Picture:
    """A panel for each combination of the matrix: a point with its interval for every arm and scenario."""
    measure = found.measures[found.claim.primary.metric]
    scale = 100.0 if measure.is_share else 1.0
    conditions = list(dict.fromkeys(condition for condition, _ in found.arms))
    panels = list(dict.fromkeys(c.values for c in conditions))
    scenarios = list(dict.fromkeys(c.scenario for c in conditions))
    width = 2.0 + max(0.9 * len(scenarios), 1.6) * len(panels)
    picture = Picture(figsize=(width, 3.4), layout="constrained")
    arms = list(found.claim.every_arm)
    for axes, values in zip(_axes(picture, 1, len(panels))[0], panels, strict=True):
        for k, arm in enumerate(arms):
            shift = 0.8 * ((k + 0.5) / len(arms) - 0.5)
            for x, scenario in enumerate(scenarios):
                if (Condition(scenario, values), arm) not in found.arms:
                    continue
                one = found.figure(Condition(scenario, values), arm, measure.name)
                label = arm if values == panels[0] and x == 0 else None
                axes.errorbar(
                    *(x + shift, scale * one.value, scale * _bars(one)),
                    fmt="o", ms=3, capsize=1.5, elinewidth=0.8, color=f"C{k}", label=label,
                )  # fmt: skip
                if (published := found.claim.published.get(scenario, {}).get(arm)) is not None:
                    axes.plot(x + shift, published, "x", ms=4, color="0.4")
        axes.set_xticks(range(len(scenarios)), scenarios, rotation=20)
        axes.set(title=Condition("", values).text, ylabel=_axis_label(measure))
        if measure.is_share and measure.better == "lower":  # separates 1 % from 2 % on an axis to 100 %
            axes.set_yscale("symlog", linthresh=1.0)
            axes.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
            axes.set_ylim(-0.1, 110.0)
        axes.grid(axis="y", alpha=0.3)
    picture.legend(loc="outside right upper", fontsize="small")
    return picture


def _front(found: Found) -> Picture:
    """A column for each condition: figures against the first one, the claim's arms joined in their order."""
    x, *others = (found.measures[name] for name in found.claim.front)
    conditions = list(dict.fromkeys(condition for condition, _ in found.arms))
    size = (2.0 + 2.4 * len(conditions), 2.1 * len(others) + 0.4)
    picture = Picture(figsize=size, layout="constrained")
    for row, y in zip(_axes(picture, len(others), len(conditions)), others, strict=True):
        for axes, condition in zip(row, conditions, strict=True):
            points = {
                arm: [found.figure(condition, arm, m.name) for m in (x, y)] for arm in found.claim.every_arm
            }
            path = [points[arm] for arm in found.claim.arms]
            axes.plot(*([p[k].value for p in path] for k in (0, 1)), color="0.6", lw=0.8)
            for k, (arm, (a, b)) in enumerate(points.items()):
                axes.errorbar(
                    *(a.value, b.value, _bars(b), _bars(a)),
                    fmt="o" if arm in found.claim.arms else "s", ms=4, elinewidth=0.7, color=f"C{k % 10}",
                    label=arm if (y, condition) == (others[0], conditions[0]) else None,
                )  # fmt: skip
            title = ", ".join(filter(None, (condition.scenario, condition.text)))
            axes.set(title=title if y == others[0] else "", xlabel=_axis_label(x), ylabel=_axis_label(y))
            axes.grid(alpha=0.3)
    picture.legend(loc="outside right upper", fontsize="small")
    return picture


def _axes(picture: Picture, rows: int, columns: int) -> Sequence[Sequence[Axes]]:
    found: Any = picture.subplots(rows, columns, squeeze=False)
    return [list(row) for row in found]


def _bars(one: Figure) -> Any:
    """[2,1] the lengths of the error bars; 0 without an interval."""
    return np.nan_to_num([[one.value - one.low], [one.high - one.value]]).clip(0.0)


def _axis_label(measure: Measure) -> str:
    return f"{measure.name}, {'%' if measure.is_share else measure.unit}".rstrip(", ")
