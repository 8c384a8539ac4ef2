"""The figures among the columns of the rows: names, units and better direction."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cosim.report.statistics import Figure, pooled_rate
from cosim.scenario.options import COLUMNS
from cosim.types import RESERVED, TIMINGS, WEIGHT

Row = Mapping[str, Any]  # one episode: a line of episodes.parquet, NA as None

SHARE = "share"  # unit of figures in per cent, compared in percentage points


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure by name, of one of three kinds.

    A rate is the share of episodes in which `column` is true or above 0. An incidence is the column's sum
    over the sum of the column `per`. Any other measure is the column's mean.
    """

    name: str
    column: str
    unit: str  # SHARE for a rate, "" if unknown
    better: str  # "higher", "lower" or ""
    is_rate: bool = False
    per: str = ""  # of an incidence: the column of its exposure
    scale: float = 1.0  # exposure in one unit: 1e6 km of "per million km"
    more: tuple[str, ...] = ()  # further columns whose events count

    @property
    def is_share(self) -> bool:
        """Between 0 and 1, shown in per cent: a rate, or the mean of shares."""
        return self.unit.split(" ")[0] == SHARE

    def values(self, rows: Sequence[Row]) -> list[float]:
        """The figure in each row, nan for NA; of a rate 1.0 or 0.0."""
        if self.per:
            return [k / t if t > 0.0 else math.nan for k, t, _ in self.tally(rows).T]
        found = _column(rows, self.column)
        return [float(x > 0) if self.is_rate and not math.isnan(x) else x for x in found]

    def tally(self, rows: Sequence[Row]) -> npt.NDArray[np.float64]:
        """[3,n] events, exposure in the figure's unit, and weight of each row; nan for NA."""
        events = np.sum([_column(rows, name) for name in (self.column, *self.more)], axis=0)
        exposure = np.array(_column(rows, self.per)) / self.scale
        return np.array([events, exposure, weights(rows)])

    def figure(self, rows: Sequence[Row]) -> Figure:
        """The weighted rate of an incidence over the rows in which neither events nor exposure are NA."""
        tally = self.tally(rows)
        return pooled_rate(*tally[:, ~np.isnan(tally).any(0)])


def weights(rows: Sequence[Row]) -> list[float]:
    """The likelihood ratio of each episode; 1 without a tilt (docs/guides/estimate.md)."""
    return [1.0 if row.get(WEIGHT) is None else float(row[WEIGHT]) for row in rows]


def _column(rows: Sequence[Row], name: str) -> list[float]:
    return [math.nan if row.get(name) is None else float(row[name]) for row in rows]


# Shares of episodes, by the names that thresholds and tables use.
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

CRASHES = "crash_rate_per_million_km"
# Events per distance, pooled over all episodes (figures.md, Rates over many episodes).
CRASH_RATES: dict[str, Measure] = {
    name: Measure(name, column, f"per million {km}", "lower", per=per, scale=1e6, more=more)
    for name, column, more, km, per in (
        (CRASHES, "av_involved_collisions", (), "AV-km", "av_km"),
        (f"av_caused_{CRASHES}", "av_caused_collisions", (), "AV-km", "av_km"),
        (f"all_{CRASHES}", "av_involved_collisions", ("hv_hv_collisions",), "vehicle-km", "vehicle_km"),
    )
}
# Events per vehicle time, pooled over all episodes (figures.md, Near-misses).
NEAR_MISS_RATES: dict[str, Measure] = {
    name: Measure(name, f"{prefix}near_misses_{kind}", f"per {hour}", "lower", per=hours)
    for prefix, hour, hours in (("av_", "AV-hour", "av_hours"), ("", "vehicle-hour", "vehicle_hours"))
    for kind in ("ttc", "drac", "pet")
    for name in (f"{prefix}near_misses_{kind}_per_{hour.lower().replace('-', '_')}",)
}
INCIDENCES = CRASH_RATES | NEAR_MISS_RATES

# Figures that reports and comparisons show first.
HEADLINE = (
    "collision_rate",
    "av_caused_collision_rate",
    "mission_success_rate",
    "dt_mission_m",
    "dt_av_m",
    "dt_mean_m",
    "min_ttc_s",
    "hard_brakings_av",
    "veto_rate",
)


def measures(
    rows: Sequence[Row], units: Mapping[str, str] | None = None, better: Mapping[str, str] | None = None
) -> dict[str, Measure]:
    """Every figure of these rows, by name: rates, then incidences, then means, then timings.

    `units` and `better` are by column, as in `cosim run --json`. Boolean columns become rates, numeric
    columns means, so a new metric needs no entry here. Tilted episodes (estimate.md) have only incidences
    and timings, because their unweighted figures do not describe real traffic.
    """
    units, better = units or {}, better or {}
    kinds: dict[str, set[type]] = {}  # of the values that are not NA
    for row in rows:
        for column, value in row.items():
            kinds.setdefault(column, set()).update(() if value is None else (type(value),))
    rates = {m.name: m for m in RATES.values() if m.column in kinds}
    incidences = {m.name: m for m in INCIDENCES.values() if {m.column, m.per, *m.more} <= kinds.keys()}
    rated = {m.column for m in rates.values() if kinds[m.column] <= {bool}}
    means = {}
    for column in [c for c in kinds if c not in {*RESERVED, *COLUMNS, *rated}]:
        if kinds[column] == {bool}:
            name = f"{column}_rate"
            rates[name] = Measure(name, column, SHARE, better.get(column, ""), True)
        elif column in units or (kinds[column] and kinds[column] <= {int, float}):
            means[column] = Measure(column, column, units.get(column, ""), better.get(column, ""))
    timings = {column: Measure(column, column, "s", "lower") for column in TIMINGS if column in kinds}
    if any(weight != 1.0 for weight in weights(rows)):
        return incidences | timings
    return rates | incidences | means | timings
