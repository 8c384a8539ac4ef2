"""What `cosim estimate` says of a cell: events per million km with intervals, and how far to trust them."""

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

FEW = 10.0  # effective crashes, below which an interval was seen to hold the truth less often than it says
HALF = 0.5  # relative half width of an interval that is called useful
POWERS = -6.0, 6.0  # of ten: how many times as many episodes are thought of
HEAVY = 0.25  # of all crashes' weight in one episode: another one like it would move the estimate


def estimate(rows: Sequence[Row]) -> dict[str, Any]:
    """Plain JSON values of the episodes of one cell; counts and km are those driven, without weights."""
    ok = [row for row in rows if row["status"] == OK]
    known = measures(ok)
    figures = {name: incidence_document(m, ok) for name, m in known.items() if m.per}
    every = np.array(weights(ok))
    crashed = every[[bool(row["av_involved_collisions"]) for row in ok]]
    return {
        CRASHES: figures[CRASHES]["value"] if CRASHES in figures else None,
        **{bound: figures[CRASHES][bound] if CRASHES in figures else None for bound in ("low", "high")},
        "episodes": len(ok),
        "tilted_episodes": sum(bool(row.get("tilted")) for row in ok),
        **{km: sum(row[km] for row in ok) for km in ("vehicle_km", "av_km")},
        "effective_samples": effective(every),
        "largest_weight_share": _largest(every),
        "crashed_episodes": len(crashed),
        "effective_crashes": effective(crashed),
        "largest_crash_share": _largest(crashed),
        "episodes_needed": round(many) if math.isfinite(many := needed(ok)) else None,
        "status": status_counts(rows),
        "figures": figures,
    }


def needed(rows: Sequence[Row]) -> float:
    """About how many episodes like these it takes until the interval of the crash rate is +- `HALF` of it
    (half of its width); inf without a crash."""
    tally = INCIDENCES[CRASHES].tally(rows)
    y, k, w = tally[:, ~np.isnan(tally).any(0)]

    def wider(power: float) -> float:
        found = pooled_rate(y, k, w, 10.0**power)
        return (found.high - found.low) / 2.0 / found.value - HALF

    return 10.0 ** float(bisect(wider, *POWERS)) * len(rows) if y.any() else math.inf


def text(found: Mapping[str, Any]) -> str:
    """The same for a terminal."""
    lines = []
    for name, figure in found["figures"].items():
        value = Figure(*(math.nan if figure[n] is None else figure[n] for n in ("value", "low", "high")))
        shown = wording.interval(value, INCIDENCES[name])
        lines.append(f"  {name:<37} {shown}, {wording.sample(figure)}")
    lines += [
        f"  {found['episodes']} episodes ({found['tilted_episodes']} tilted), {found['av_km']:.0f} AV-km, "
        f"{found['vehicle_km']:.0f} vehicle-km; effective samples {found['effective_samples']:.0f}, "
        f"largest weight {_percent(found['largest_weight_share'])} of all",
        f"  {found['crashed_episodes']} episodes with a crash of an AV: effective "
        f"{found['effective_crashes']:.1f}, largest {_percent(found['largest_crash_share'])} of their weight",
    ]
    return "\n".join([*lines, *(f"  note: {note}" for note in _notes(found))])


def _notes(found: Mapping[str, Any]) -> list[str]:
    """What makes the interval less than it says."""
    if not found["crashed_episodes"]:
        return ["no AV crashed: of the crash rate only the upper bound is known"]
    many = found["episodes_needed"]
    notes = [f"+-{100 * HALF:.0f} % takes about {many} episodes"] if many > found["episodes"] else []
    if found["effective_crashes"] < FEW:
        notes.append(f"fewer than {FEW:.0f} effective crashes: go on with more --episodes")
    if (found["largest_crash_share"] or 0.0) > HEAVY:
        notes.append("one crash holds much of the weight: the tilt misses how it came about")
    return notes


def _largest(values: npt.NDArray[np.float64]) -> float | None:
    """The largest of these weights as a share of their sum."""
    return float(values.max() / values.sum()) if len(values) else None


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f} %"
