"""Texts of figures: per cent and percentage points, units, intervals, NA."""

import math
from collections.abc import Mapping
from typing import Any

from cosim.report.figures import Measure
from cosim.report.statistics import Figure

NA_TEXT = "NA"
SEVERAL = 2  # episodes or pairs from which an interval is shown


def number(
    value: float, measure: Measure, *, signed: bool = False, unit: bool = True, places: int | None = None
) -> str:
    """`12.5 %`, `+0.5 pp` (a signed share is a difference of shares), `543 m`, `NA`.

    `places`: decimals; by default three significant digits or so.
    """
    if math.isnan(value):
        return NA_TEXT
    name = measure.unit
    if measure.is_share:
        value, name = 100.0 * value, "pp" if signed else "%"
    text = _digits(value, signed, places)
    return f"{text} {name}" if unit and name else text


def change(value: float) -> str:
    """A relative change: `-3.2 %`."""
    return NA_TEXT if math.isnan(value) else f"{_digits(100.0 * value, True, 1)} %"


def interval(
    figure: Figure, measure: Measure, *, signed: bool = False, unit: bool = True, n: int = SEVERAL
) -> str:
    """`12.5 % (4.4 to 26.1)`; see `value_and_bounds`."""
    value, bounds = value_and_bounds(figure, measure, signed=signed, unit=unit, n=n)
    return f"{value} ({bounds})" if bounds else value


def value_and_bounds(
    figure: Figure, measure: Measure, *, signed: bool = False, unit: bool = True, n: int = SEVERAL
) -> tuple[str, str]:
    """`12.5 %` and `4.4 to 26.1`, to two digits of the interval's width.

    No bounds if the shown interval would have no width, or if there are fewer than `SEVERAL` episodes or
    pairs (`n`).
    """
    width = (figure.high - figure.low) * (100.0 if measure.is_share else 1.0)
    bare = number(figure.value, measure, signed=signed, unit=unit)
    if n < SEVERAL or not figure.known or not 0.0 < width < math.inf:
        return bare, ""
    places = min(max(1 - math.floor(math.log10(width)), 1 if measure.is_share else 0), 4)
    value, low, high = (
        number(x, measure, signed=signed, unit=named, places=places)
        for x, named in ((figure.value, unit), (figure.low, False), (figure.high, False))
    )
    return (value, f"{low} to {high}") if low != high else (bare, "")


def sample(counts: Mapping[str, Any]) -> str:
    """`3/40` of a rate, `12 in 3.4 h` of an incidence; `n 40, 2 NA` of a mean with episodes that are NA."""
    if counts.get("events") is not None:
        text = events(counts["events"], counts["exposure"], counts["per"])
        return f"{text}, {counts['na']} NA" if counts.get("na") else text
    if counts.get("hits") is not None:
        text = f"{counts['hits']}/{counts['n']}"
        return f"{text}, {counts['na']} NA" if counts.get("na") else text
    return f"n {counts['n']}, {counts['na']} NA" if counts.get("na") else ""


def events(count: int, exposure: float, per: str) -> str:
    """`12 in 3.4 h`, `1 in 850 km`; `per`: the column of the exposure."""
    return f"{count} in {_digits(exposure, False)} {'km' if per.endswith('km') else 'h'}"


def p_value(p: float) -> str:
    """`p 0.03`, `p < 0.001`."""
    return "p < 0.001" if p < 0.001 else f"p {p:.2g}"


def counted(number: int, noun: str) -> str:
    """`1 pair`, `2 pairs`."""
    return f"{number} {noun}{'s' * (number != 1)}"


def group(identity: Mapping[str, Any]) -> str:
    """`merge / contested / idm / moderate / unguarded / svo 45 / lc2013`."""
    forms = {
        "scenario": "{}",
        "demand": "{}",
        "policy": "{}",
        "behavior": "{}",
        "preset": "{}",
        "errors": "errors {}",
        "sensing": "sensing {}",
        "svo_deg": "svo {:g}",
        "penetration": "penetration {:g}",
        "driver_model": "{}",
    }
    known = {name: identity.get(name) for name in forms}
    return " / ".join(forms[name].format(value) for name, value in known.items() if value is not None)


def _digits(value: float, signed: bool, places: int | None = None) -> str:
    """The number without an exponent below a million, and without a sign before a zero."""
    sign = "+" if signed else ""
    size = abs(value)
    if math.isinf(value) or size >= 1e6:
        return f"{value:{sign}.3g}"
    shown = places
    if shown is None:
        shown = 0 if size >= 100 else 1 if size >= 10 or size == 0 else 2 if size >= 1 else 3
    text = f"{value:{sign}.{shown}f}"
    text = text.rstrip("0").rstrip(".") if places is None and shown else text
    return text.lstrip("+-") if not text.strip("+-0.") else text
