"""Speeding: share of time and largest excess of AVs above their lane's limit."""

import numpy as np
import numpy.typing as npt

from cosim.geometry.compiled import compiled
from cosim.metrics.context import AV, MetricContext
from cosim.road.lane import NO_LIMIT
from cosim.types import Floats, Metric, Snapshot

TOLERANCE = 0.5  # m/s


class Speeding:
    """Over all frames of AVs on a lane of the map, lanes inside junctions included."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        limits = np.array([lane.speed_limit for lane in context.road.lanes], np.float64)  # [l] m/s
        self._limits = np.where(limits == NO_LIMIT, np.inf, limits)
        self._frames = self._above = 0
        self._worst = 0.0  # m/s
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        limits = self._limits
        if snapshot.limits:
            limits = limits.copy()
            limits[list(snapshot.limits)] = list(snapshot.limits.values())
        frames, above, worst = _excess(snapshot.kind, snapshot.speed, snapshot.lane, limits)
        self._frames += frames
        self._above += above
        self._worst = max(self._worst, worst)

    def result(self) -> dict[str, Metric]:
        share, worst = (self._above / self._frames, self._worst) if self._frames else (None, None)
        return {
            "speeding_share": Metric(share, "share of vehicle time", "lower"),
            "worst_speeding_mps": Metric(worst, "m/s", "lower"),
        }


@compiled
def _excess(
    kind: npt.NDArray[np.int8], speed: Floats, lane: npt.NDArray[np.int32], limits: Floats
) -> tuple[int, int, float]:
    """Number of AVs on a lane, number of those speeding, largest excess (m/s)."""
    frames, above, worst = 0, 0, 0.0
    for k in range(len(kind)):
        if kind[k] != AV or lane[k] < 0:
            continue
        frames += 1
        excess = speed[k] - limits[lane[k]]
        above += excess > TOLERANCE
        worst = max(worst, excess)
    return frames, above, worst
