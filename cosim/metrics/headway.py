"""Headway: the time gap that AVs keep to the vehicle ahead in their corridor, mean and smallest."""

from __future__ import annotations

import numpy as np

from cosim.geometry import gap_ahead, headway
from cosim.metrics.context import AV, MetricContext
from cosim.types import Metric, Snapshot


class Headway:
    """Net time headway (bumper to bumper) over all AV frames with a vehicle within 125 m ahead."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._graph = context.road.straight_on
        self._sum = 0.0  # s
        self._counted = 0
        self._smallest = np.inf  # s
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        av = np.flatnonzero(snapshot.kind == AV)
        if not len(av):
            return
        gap, _ = gap_ahead(snapshot, self._graph, av)
        for time in headway(gap, snapshot.speed[av]).tolist():
            if time < np.inf:
                self._sum += time
                self._counted += 1
                self._smallest = min(self._smallest, time)

    def result(self) -> dict[str, Metric]:
        mean, smallest = (self._sum / self._counted, self._smallest) if self._counted else (None, None)
        return {
            "mean_headway_s": Metric(mean, "s", ""),
            "min_headway_s": Metric(smallest, "s", "higher"),
        }
