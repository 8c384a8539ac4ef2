"""Time to collision of AVs and mission vehicles with anybody: the smallest, and how long it was critical."""

from __future__ import annotations

import numpy as np

from cosim.geometry import boxes, pairs_time_to_collision
from cosim.metrics.context import MetricContext, watched
from cosim.types import Metric, Snapshot

CRITICAL = 1.5  # s, the usual bound of a serious conflict (van der Horst 1990); papers.md's critical_th
HORIZON = 10.0  # s, beyond it straight-line extrapolation says nothing (papers.md: cap ttc)


class TimeToCollision:
    """Swept oriented boxes at constant velocity; `min_ttc_s` is NA when nobody came within 10 s."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._smallest = HORIZON
        self._critical = self._counted = 0  # vehicle-frames
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        rows = np.flatnonzero(watched(snapshot))
        if not len(rows):
            return
        nearest = pairs_time_to_collision(boxes(snapshot), rows, HORIZON).min(axis=1)  # [k] s
        self._smallest = min(self._smallest, float(nearest.min()))
        self._critical += int((nearest < CRITICAL).sum())
        self._counted += len(rows)

    def result(self) -> dict[str, Metric]:
        share = self._critical / self._counted if self._counted else None
        return {
            "min_ttc_s": Metric(self._smallest if self._smallest < HORIZON else None, "s", "higher"),
            "ttc_below_1_5_share": Metric(share, "share of vehicle time", "lower"),
        }
