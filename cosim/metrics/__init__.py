"""Every figure of an episode, in SI units: one file per metric, one line each in the table below."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from cosim.errors import BadInput
from cosim.files import code
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

__all__ = ["METRICS", "EpisodeMetric", "MetricContext", "MetricFactory", "Metrics", "joined", "read"]

MetricFactory = Callable[[], EpisodeMetric]  # a class, or anything that makes an object of one

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
    """All metrics of the table and those of `more`, run side by side."""

    def __init__(self, more: Sequence[MetricFactory] = ()) -> None:
        kinds: list[MetricFactory] = [*METRICS.values(), *more]
        self._metrics = [kind() for kind in kinds]
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
        """Name -> figure with unit and better direction, in the table's order. Raises as `joined`."""
        return joined(*(metric.result() for metric in self._metrics))


def joined(*parts: Mapping[str, Metric]) -> dict[str, Metric]:
    """The figures of several metrics. Raises BadInput: two have one name, or a figure is no `Metric`."""
    figures: dict[str, Metric] = {}
    for part in parts:
        for name, figure in part.items():
            if name in figures:
                raise BadInput("another metric has a figure of this name", field="metric", value=name)
            if not isinstance(figure, Metric):
                raise BadInput("must be a cosim.types.Metric", field=f"metric.{name}", value=figure)
            figures[name] = figure
    return figures


def read(what: str | MetricFactory, field: str = "--metric") -> MetricFactory:
    """What makes the metric of the class FILE.py:NAME or MODULE:NAME; a class or factory is that already.

    Those of `METRICS` are measured in any case. Raises BadInput: its code cannot be loaded.
    """
    if not isinstance(what, str):
        return what
    own = code.read(what, field)
    own.load(field)
    return partial(own.make, field)
