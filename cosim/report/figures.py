"""Which columns of the rows are figures, what they are called, their units, and which direction is better."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.batch.records import IDENTITY, LAST

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
        found = []
        for row in rows:
            value = row.get(self.column)
            if value is None or (isinstance(value, float) and math.isnan(value)):
                found.append(math.nan)
            else:
                found.append(float(value > 0) if self.is_rate else float(value))
        return found


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

# Columns that stand first -> the measure that reports and comparisons show of them; "" where none.
_FIRST = {
    "crashed": "collision_rate",
    "collisions": "",
    "av_caused_collisions": "av_caused_collision_rate",
    "teleports": "",
    "emergency_stops": "",
    "mission_success": "mission_success_rate",
    "mission_time_s": "",
    "dt_mission_m": "dt_mission_m",
    "dt_av_m": "dt_av_m",
    "dt_mean_m": "dt_mean_m",
    "min_ttc_s": "min_ttc_s",
    "hard_brakings_av": "hard_brakings_av",
    "veto_rate": "veto_rate",
    "vehicles_inserted": "",
    "vehicles_never_inserted": "",
}
EPISODE = tuple(_FIRST)  # what the table of one episode shows
HEADLINE = tuple(filter(None, _FIRST.values()))  # what reports and comparisons show first

TIMINGS = ("reset_s", "simulation_s", "observation_s", "decision_s", "total_s")  # wall time: never repeatable

# What identifies, explains or times an episode, but measures nothing of the traffic.
_NOT_FIGURES = frozenset(
    (
        *IDENTITY,
        *LAST,
        "steps",
        "trace_hash",
        "timings",
        "comparable",
        "not_comparable_because",
        "collision_list",
    )
)


def measures(
    rows: Iterable[Row], units: Mapping[str, str] | None = None, better: Mapping[str, str] | None = None
) -> dict[str, Measure]:
    """Every figure these rows hold, by name: rates, then means, then timings.

    `units` and `better` say by column what `cosim run --json` says of its metrics. Columns of yes and no
    give rates, of numbers means; so a metric that is new has its figure without being listed here.
    """
    units, better = units or {}, better or {}
    kinds: dict[str, type] = {}
    columns: dict[str, None] = {}
    for row in rows:
        for column, value in row.items():
            columns[column] = None
            if value is not None and kinds.get(column, int) is int:
                kinds[column] = type(value)  # a column of 1 and 2.5 is one of floats
    found = {m.name: m for m in RATES.values() if m.column in columns}
    rated = {m.column for m in found.values() if kinds.get(m.column, bool) is bool}
    means = {}
    for column in columns:
        if column in _NOT_FIGURES or column in TIMINGS or column in rated:
            continue
        if kinds.get(column) is bool:
            name = f"{column}_rate"
            found[name] = Measure(name, column, SHARE, better.get(column, ""), True)
        elif kinds.get(column) in (int, float) or column in units:
            means[column] = Measure(column, column, units.get(column, ""), better.get(column, ""))
    timings = {column: Measure(column, column, "s", "lower") for column in TIMINGS if column in columns}
    return found | means | timings
