"""Which columns of the rows are figures, what they are called, their units, and which direction is better."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cosim.report.result import FIRST
from cosim.report.statistics import Figure, weighted_rate
from cosim.types import RESERVED, TIMINGS, WEIGHT

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


@dataclass(frozen=True, slots=True)
class Frequency(Measure):
    """Events per exposure: sums over episodes, each with its weight (docs/estimate.md).

    `column` is the exposure's; an episode's value is its own quotient.
    """

    events: tuple[str, ...] = ()  # columns of counts, added up
    scale: float = 1.0  # of the quotient: 1e6 where the column is in km and the unit million km

    def values(self, rows: Sequence[Row]) -> list[float]:
        """The figure in each row, nan for NA and where there is no exposure."""
        counts, exposures, _ = self.parts(rows)
        return [c / e if e > 0.0 else math.nan for c, e in zip(counts, exposures, strict=True)]

    def parts(self, rows: Sequence[Row]) -> npt.NDArray[np.float64]:
        """[3,n] events, exposure and weight of each row; the exposure in the figure's unit, nan for NA."""
        found = np.array([[row.get(name) for name in (self.column, *self.events)] for row in rows], float)
        found = found.reshape(len(rows), 1 + len(self.events))
        return np.array([found[:, 1:].sum(1), found[:, 0] / self.scale, weights(rows)])

    def figure(self, rows: Sequence[Row]) -> Figure:
        """Its value over rows and the interval; rows in which it is NA are left out."""
        parts = self.parts(rows)
        return weighted_rate(*parts[:, ~np.isnan(parts).any(0)])


def weights(rows: Sequence[Row]) -> list[float]:
    """The likelihood ratio of each episode; 1 where its errors were not tilted."""
    return [1.0 if row.get(WEIGHT) is None else float(row[WEIGHT]) for row in rows]


CRASHES = "crash_rate_per_million_km"
# Events per exposure, by the name that thresholds and tables use.
FREQUENCIES: dict[str, Frequency] = {
    name: Frequency(name, column, unit, "lower", events=events, scale=scale)
    for name, events, column, scale, unit in (
        (CRASHES, ("av_involved_collisions",), "av_km", 1e6, "per million AV-km"),
        (f"av_caused_{CRASHES}", ("av_caused_collisions",), "av_km", 1e6, "per million AV-km"),
        (
            f"all_{CRASHES}",
            ("av_involved_collisions", "hv_hv_collisions"),
            "vehicle_km",
            1e6,
            "per million vehicle-km",
        ),
    )
}


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
    rows: Sequence[Row], units: Mapping[str, str] | None = None, better: Mapping[str, str] | None = None
) -> dict[str, Measure]:
    """Every figure these rows hold, by name: rates, then means, events per exposure, timings.

    Of episodes whose errors were tilted only those that weigh them: others would be those of no traffic.

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
    frequencies = {m.name: m for m in FREQUENCIES.values() if kinds.keys() >= {m.column, *m.events}}
    if any(weight != 1.0 for weight in weights(rows)):
        return frequencies | timings
    return rates | means | frequencies | timings
