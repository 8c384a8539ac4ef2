"""The small language of `cosim compare --fail-on`, e.g. `collision_rate.upper > +0.5pp`.

    METRIC[.upper|.lower]  >|<  [+|-]NUMBER[UNIT]

With a sign the threshold is for the difference B - A on equal seeds, without a sign for the figure of B.
UNIT: `pp` (a difference of shares, in percentage points), `%` (a share; with a sign the change of a mean
relative to A's), or the metric's own unit, which may be left out. `.upper` and `.lower` use that bound of
the 95 % interval instead of the value. A share needs its unit, unless it is 0: 0.5 might be a half or half
a per cent.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from cosim.errors import BadInput, hint
from cosim.report.figures import Measure
from cosim.report.statistics import Figure

DIFFERENCE, CHANGE, ABSOLUTE = "difference", "change", "absolute"

_FORM = re.compile(
    r"""\s*(?P<metric>[A-Za-z]\w*) (\s*\.\s*(?P<bound>\w+))?
        \s*(?P<sense>[<>])
        \s*(?P<sign>[+-]?)\s*(?P<number>(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?)
        \s*(?P<unit>\S.*?)?\s*""",
    re.VERBOSE,
)
_SLACK = 1e-12  # for rounding: 1 of 200 is not more than 0.5 %


@dataclass(frozen=True, slots=True)
class Threshold:
    """One `--fail-on`: fails if the figure is beyond `limit` in the direction of `sense`."""

    text: str  # as the user typed it
    measure: Measure
    bound: str  # "value", "upper" or "lower"
    sense: str  # ">" or "<"
    limit: float  # in the metric's own unit; of a CHANGE and of shares as a fraction
    kind: str  # DIFFERENCE, CHANGE or ABSOLUTE

    def of(self, figure: Figure) -> float:
        """The value or bound of a figure that is compared with the limit; nan if it is missing."""
        return {"value": figure.value, "upper": figure.high, "lower": figure.low}[self.bound]

    def fails(self, number: float) -> bool:
        """Whether a number is beyond the limit. nan (NA, or a missing bound) fails."""
        slack = _SLACK * max(1.0, abs(self.limit))
        return not (number <= self.limit + slack if self.sense == ">" else number >= self.limit - slack)


def parse(text: str, known: Mapping[str, Measure]) -> Threshold:
    """Read one threshold; `known`: the figures of the runs, by name.

    Raises:
        BadInput: another form, an unknown metric (with the nearest name), a unit of another kind.
    """
    parts = _FORM.fullmatch(text)
    if parts is None:
        problem = "write METRIC[.upper|.lower] > or < [+|-]NUMBER[UNIT], as in 'collision_rate > +0.5pp'"
        raise _wrong(problem, text)
    names = {**{m.column: m for m in known.values() if m.is_rate}, **known}  # `crashed` is `collision_rate`
    measure = names.get(parts["metric"])
    if measure is None:
        near = hint(parts["metric"], known) or f", there are: {', '.join(known)}"
        raise _wrong(f"unknown metric {parts['metric']!r}{near}", text)
    bound = parts["bound"] or "value"
    if bound not in ("value", "upper", "lower"):
        raise _wrong(f"unknown bound .{bound}: there are .upper and .lower", text)
    number = float(parts["number"])
    kind, scale = _unit(measure, parts["sign"], number, parts["unit"], text)
    limit = scale * number * (-1.0 if parts["sign"] == "-" else 1.0)
    return Threshold(" ".join(text.split()), measure, bound, parts["sense"], limit, kind)


def _unit(measure: Measure, sign: str, number: float, unit: str | None, text: str) -> tuple[str, float]:
    """The threshold's kind, and its unit in the metric's own unit."""
    kind = DIFFERENCE if sign else ABSOLUTE
    if unit is None and measure.is_share and number != 0.0:
        raise _wrong(f"{measure.name} is a share: write {'pp' if sign else '%'} after the number", text)
    if unit is None or (unit == measure.unit and unit not in ("%", "pp")):
        return kind, 1.0
    if unit == "pp":
        if measure.is_share and sign:
            return DIFFERENCE, 0.01
        why = "write + or - before it" if measure.is_share else f"{measure.name} is in {_unit_of(measure)}"
        raise _wrong(f"pp is for differences of shares: {why}", text)
    if unit == "%":
        if measure.is_share and sign:
            raise _wrong("a difference of shares is given in pp (percentage points)", text)
        if measure.is_share or sign:
            return (CHANGE if sign else ABSOLUTE), 0.01
        raise _wrong(f"{measure.name} is in {_unit_of(measure)}; with + or - it may be a change in %", text)
    raise _wrong(f"unknown unit {unit!r}: {measure.name} is in {_unit_of(measure)}", text)


def _unit_of(measure: Measure) -> str:
    return (
        f"{measure.unit} (% or pp)" if measure.is_share else measure.unit or "a unit this run does not name"
    )


def _wrong(problem: str, text: str) -> BadInput:
    return BadInput(problem, field="--fail-on", value=text)
