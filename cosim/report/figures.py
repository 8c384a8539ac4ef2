"""Which columns of the rows are figures, what they are called, their units, and which direction is better."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.report.result import FIRST
from cosim.types import RESERVED, TIMINGS

Row = Mapping[str, Any]  # one episode: a line of episodes.parquet, NA as None

SHARE = "share"  # unit of what is shown in per cent and compared in percentage points


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure by name: the share of episodes in which `column` is true or above 0, or the column's mean."""

    name: str
    column: str
    unit: str  # SHARE for a rate, "" where the run does not say
    better: str  # "higher", "lower" or ""
    is_rate: bool = False

    @property
    def is_share(self) -> bool:
        """Between 0 and 1, shown in per cent: a rate, or the mean of shares."""
        return self.unit.split(" ")[0] == SHARE

    def values(self, rows: Sequence[Row]) -> list[float]:
        """The figure in each row, nan for NA; of a rate 1.0 or 0.0."""
        found = [math.nan if row.get(self.column) is None else float(row[self.column]) for row in rows]
        return [float(x > 0) if self.is_rate and not math.isnan(x) else x for x in found]


# Shares of episodes, by the name that thresholds and tables use.
RATES: dict[str, Measure] = {
    name: Measure(name, column, SHARE, better, True)
    for name, column, better in (
        ("collision_rate", "crashed", "lower"),  # C% of the papers
        ("av_caused_collision_rate", "av_caused_collisions", "lower"),
        ("hv_hv_collision_rate", "hv_hv_collisions", "lower"),
        ("mission_success_rate", "mission_success", "higher"),
        ("mission_failed_rate", "mission_failed_at_end", "lower"),
    )
}

HEADLINE = tuple(filter(None, FIRST.values()))  # what reports and comparisons show first


def measures(
    rows: Iterable[Row], units: Mapping[str, str] | None = None, better: Mapping[str, str] | None = None
) -> dict[str, Measure]:
    """Every figure these rows hold, by name: rates, then means, then timings.

    `units` and `better` say by column what `cosim run --json` says of its metrics. Columns of yes and no
    give rates, of numbers means; so a metric that is new has its figure without being listed here.
    """
    units, better = units or {}, better or {}
    kinds: dict[str, set[type]] = {}  # of the values that are not NA
    for row in rows:
        for column, value in row.items():
            kinds.setdefault(column, set()).update(() if value is None else (type(value),))
    rates = {m.name: m for m in RATES.values() if m.column in kinds}
    rated = {m.column for m in rates.values() if kinds[m.column] <= {bool}}
    means = {}
    for column in [c for c in kinds if c not in RESERVED | rated]:
        if kinds[column] == {bool}:
            name = f"{column}_rate"
            rates[name] = Measure(name, column, SHARE, better.get(column, ""), True)
        elif column in units or (kinds[column] and kinds[column] <= {int, float}):
            means[column] = Measure(column, column, units.get(column, ""), better.get(column, ""))
    timings = {column: Measure(column, column, "s", "lower") for column in TIMINGS if column in kinds}
    return rates | means | timings
