"""A cell of `cosim estimate`: events per million km with intervals, and their reliability."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import bisect

from cosim.report import wording
from cosim.report.figures import CRASHES, INCIDENCES, Row, measures, weights
from cosim.report.statistics import Figure, effective, pooled_rate
from cosim.report.summary import incidence_document, status_counts
from cosim.workers.tasks import OK

MIN_EFFECTIVE_CRASHES = 10.0  # with fewer, measured coverage of the intervals is below 95 %
USEFUL_HALF_WIDTH = 0.5  # of an interval, relative to the rate
SCALE_POWERS = -6.0, 6.0  # of ten: the range of multiples of the episodes that is searched
MAX_CRASH_SHARE = 0.25  # of one episode in the weight of all crashes: a similar one would change the estimate


def estimate(rows: Sequence[Row]) -> dict[str, Any]:
    """Plain JSON values of the episodes of one cell; counts and km are as driven, without weights."""
    ok = [row for row in rows if row["status"] == OK]
    known = measures(ok)
    figures = {name: incidence_document(m, ok) for name, m in known.items() if m.per}
    all_weights = np.array(weights(ok))
    crash_weights = all_weights[[bool(row["av_involved_collisions"]) for row in ok]]
    return {
        CRASHES: figures[CRASHES]["value"] if CRASHES in figures else None,
        **{bound: figures[CRASHES][bound] if CRASHES in figures else None for bound in ("low", "high")},
        "episodes": len(ok),
        "tilted_episodes": sum(bool(row.get("tilted")) for row in ok),
        **{km: sum(row[km] for row in ok) for km in ("vehicle_km", "av_km")},
        "effective_samples": effective(all_weights),
        "largest_weight_share": _largest_share(all_weights),
        "crashed_episodes": len(crash_weights),
        "effective_crashes": effective(crash_weights),
        "largest_crash_share": _largest_share(crash_weights),
        "episodes_needed": round(count) if math.isfinite(count := needed(ok)) else None,
        "status": status_counts(rows),
        "figures": figures,
    }


def needed(rows: Sequence[Row]) -> float:
    """Approximate number of such episodes for an interval of +- `USEFUL_HALF_WIDTH` of the crash rate.

    inf without a crash.
    """
    tally = INCIDENCES[CRASHES].tally(rows)
    y, k, w = tally[:, ~np.isnan(tally).any(0)]

    def excess_half_width(power: float) -> float:
        rate = pooled_rate(y, k, w, 10.0**power)
        return (rate.high - rate.low) / 2.0 / rate.value - USEFUL_HALF_WIDTH

    return 10.0 ** float(bisect(excess_half_width, *SCALE_POWERS)) * len(rows) if y.any() else math.inf


def text(cell: Mapping[str, Any]) -> str:
    """The document of `estimate` for a terminal."""
    lines = []
    for name, figure in cell["figures"].items():
        value = Figure(*(math.nan if figure[n] is None else figure[n] for n in ("value", "low", "high")))
        shown = wording.interval(value, INCIDENCES[name])
        lines.append(f"  {name:<37} {shown}, {wording.sample(figure)}")
    lines += [
        f"  {cell['episodes']} episodes ({cell['tilted_episodes']} tilted), {cell['av_km']:.0f} AV-km, "
        f"{cell['vehicle_km']:.0f} vehicle-km; effective samples {cell['effective_samples']:.0f}, "
        f"largest weight {_percent(cell['largest_weight_share'])} of all",
        f"  {cell['crashed_episodes']} episodes with a crash of an AV: effective "
        f"{cell['effective_crashes']:.1f}, largest {_percent(cell['largest_crash_share'])} of their weight",
    ]
    return "\n".join([*lines, *(f"  note: {note}" for note in _notes(cell))])


def _notes(cell: Mapping[str, Any]) -> list[str]:
    """Limits of the interval's reliability."""
    if not cell["crashed_episodes"]:
        return ["no AV crashed: only the upper bound of the crash rate is known"]
    count = cell["episodes_needed"]
    useful = f"+-{100 * USEFUL_HALF_WIDTH:.0f} %"
    notes = [f"{useful} takes about {count} episodes"] if count > cell["episodes"] else []
    if cell["effective_crashes"] < MIN_EFFECTIVE_CRASHES:
        notes.append(
            f"fewer than {MIN_EFFECTIVE_CRASHES:.0f} effective crashes: continue with more --episodes"
        )
    if (cell["largest_crash_share"] or 0.0) > MAX_CRASH_SHARE:
        notes.append("one crash has much of the weight: the tilt does not cover its cause")
    return notes


def _largest_share(values: npt.NDArray[np.float64]) -> float | None:
    """The largest of these weights as a share of their sum."""
    return float(values.max() / values.sum()) if len(values) else None


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f} %"
