"""DRAC: the hardest constant braking that an AV or mission vehicle, or its opponent, would have needed."""

from __future__ import annotations

import numpy as np

from cosim.geometry import boxes, largest_deceleration_to_avoid_crash
from cosim.metrics.context import MetricContext, watched
from cosim.types import Metric, Snapshot

HORIZON = 10.0  # s, conflicts further ahead are no conflicts yet (as for time to collision)


class DecelerationRate:
    """Largest over frames and pairs; overlapping pairs (a collision already) are not counted.

    NA when no such vehicle was there, 0 when none was ever on a collision course.
    """

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._largest: float | None = None
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        rows = np.flatnonzero(watched(snapshot))
        if len(rows):
            needed = largest_deceleration_to_avoid_crash(boxes(snapshot), rows, HORIZON)
            self._largest = max(self._largest or 0.0, needed)

    def result(self) -> dict[str, Metric]:
        return {"max_drac_mps2": Metric(self._largest, "m/s2", "lower")}
