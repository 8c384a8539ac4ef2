"""Every figure of an episode, in SI units: one file per metric, one line each in the table below."""

from __future__ import annotations

from cosim.metrics.collisions import Collisions
from cosim.metrics.context import EpisodeMetric, MetricContext
from cosim.metrics.distance import Distance
from cosim.metrics.drac import DecelerationRate
from cosim.metrics.events import TrafficEvents
from cosim.metrics.hard_braking import HardBraking
from cosim.metrics.headway import Headway
from cosim.metrics.jerk import Jerk
from cosim.metrics.mission import MissionSuccess
from cosim.metrics.post_encroachment import PostEncroachment
from cosim.metrics.time_to_collision import TimeToCollision
from cosim.types import Kind, Metric, Snapshot

__all__ = ["METRICS", "EpisodeMetric", "MetricContext", "Metrics"]

METRICS: dict[str, type[EpisodeMetric]] = {
    "collisions": Collisions,
    "events": TrafficEvents,
    "mission": MissionSuccess,
    "distance": Distance,
    "time_to_collision": TimeToCollision,
    "post_encroachment": PostEncroachment,
    "drac": DecelerationRate,
    "hard_braking": HardBraking,
    "jerk": Jerk,
    "headway": Headway,
}


class Metrics:
    """All metrics of the table, run side by side."""

    def __init__(self) -> None:
        self._metrics = [kind() for kind in METRICS.values()]
        self.had_avs = False  # whether an AV was ever on the road

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        """A new episode begins with its first frame."""
        self.had_avs = bool((first.kind == Kind.AV).any())
        for metric in self._metrics:
            metric.reset(first, context)

    def add(self, snapshot: Snapshot) -> None:
        """Count one more frame."""
        self.had_avs = self.had_avs or bool((snapshot.kind == Kind.AV).any())
        for metric in self._metrics:
            metric.add(snapshot)

    def result(self) -> dict[str, Metric]:
        """Name -> figure with unit and better direction, in the table's order."""
        figures: dict[str, Metric] = {}
        for metric in self._metrics:
            figures |= metric.result()
        return figures
