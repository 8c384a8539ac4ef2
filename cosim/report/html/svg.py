"""matplotlib's SVG made fit for a page: colours of the page's theme, its fonts, ids that do not clash."""

from __future__ import annotations

import hashlib
import io
import re
from contextlib import AbstractContextManager
from typing import Any

from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDTH = 5.6  # inches; 1 in the drawing is 72 px on the page, so a phone shows its letters almost full size

# matplotlib wants colours, the page has variables that differ in light and dark: these stand in for them.
INK, FAINT, GRID = "#010101", "#020202", "#030303"
SERIES = tuple(f"#0400{k:02x}" for k in range(1, 9))
_THEME = {
    INK: "var(--ink)",
    FAINT: "var(--faint)",
    GRID: "var(--line)",
    **{stand_in: f"var(--series-{k})" for k, stand_in in enumerate(SERIES, 1)},
}
_STYLE: Any = {
    "svg.fonttype": "none",  # text stays text: it can be read, searched, and takes the page's font
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


def themed() -> AbstractContextManager[None]:
    """While it lasts, everything drawn wears the page's theme."""
    return rc_context(_STYLE)


def canvas(rows: float) -> tuple[Figure, Axes]:
    """An empty drawing with room for `rows` rows of a series each."""
    figure = Figure(figsize=(WIDTH, 0.55 + 0.36 * rows), layout="constrained")
    return figure, figure.add_subplot()


def render(figure: Figure, title: str) -> Markup:
    """The drawing as one `<svg>` element, safe to put into the page."""
    raw = io.StringIO()
    figure.savefig(raw, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = raw.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, variable in _THEME.items():
        text = text.replace(stand_in, variable)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    prefix = f"d{hashlib.sha256(text.encode()).hexdigest()[:8]}-"
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{prefix}", text)
    opening, rest = text.split(">", 1)
    box = re.search(r'viewBox="[^"]*"', opening)
    name = Markup.escape(title)
    return Markup(f'<svg xmlns="http://www.w3.org/2000/svg" {box[0] if box else ""} role="img">') + Markup(
        f"<title>{name}</title>{rest}"
    )
