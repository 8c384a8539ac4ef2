"""Saves diagrams as small PNG files, because every checkout holds those of docs/results."""

import io
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

DPI = 110
COLOURS = 96  # of the palette: a third of the bytes, no difference to be seen in curves and bars


def save(figure: Figure, path: Path) -> None:
    """Write the figure with a palette. OSErrors are not caught."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    picture = Image.open(drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    picture.save(path, "png", optimize=True)
