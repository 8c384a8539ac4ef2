"""Every figure of an episode, in SI units: one file per metric, one line each in the table below."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from numbers import Number

from cosim.errors import BadInput
from cosim.files import code
from cosim.metrics.arrivals import Arrivals
from cosim.metrics.collisions import Collisions
from cosim.metrics.context import EpisodeMetric, MetricContext
from cosim.metrics.distance import Distance
from cosim.metrics.drac import DecelerationRate
from cosim.metrics.emissions import Emissions
from cosim.metrics.events import TrafficEvents
from cosim.metrics.hard_braking import HardBraking
from cosim.metrics.headway import Headway
from cosim.metrics.human_errors import HumanErrors
from cosim.metrics.jerk import Jerk
from cosim.metrics.law import AvCounts, StopLines
from cosim.metrics.mean_speed import MeanSpeed
from cosim.metrics.mission import MissionSuccess
from cosim.metrics.near_misses import Exposure
from cosim.metrics.persons import PersonConflicts
from cosim.metrics.post_encroachment import PostEncroachment
from cosim.metrics.speeding import Speeding
from cosim.metrics.standing import Standing
from cosim.metrics.time_to_collision import TimeToCollision
from cosim.metrics.total_delay import TotalDelay
from cosim.metrics.trips import Interventions, Trips
from cosim.metrics.waits import Waits
from cosim.scenario.options import COLUMNS
from cosim.types import RESERVED, Kind, Metric, Offence, Snapshot

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
    "stop_lines": StopLines,
    "speeding": Speeding,
    "standing": Standing,
    "trips": Trips,
    "persons": PersonConflicts,
    "interventions": Interventions,
    "exposure": Exposure,
    "human_errors": HumanErrors,
    "total_delay": TotalDelay,
    "arrivals": Arrivals,
    "mean_speed": MeanSpeed,
    "waits": Waits,
    "emissions": Emissions,
}


class Metrics:
    """All metrics of the table and those of `more`, run side by side."""

    def __init__(self, more: Sequence[MetricFactory] = ()) -> None:
        kinds: list[MetricFactory] = [*METRICS.values(), *more]
        self._metrics = [kind() for kind in kinds]
        self.had_avs = False  # whether an AV was ever on the road

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        """Start an episode with its first frame."""
        self.had_avs = bool((first.kind == Kind.AV).any())
        for metric in self._metrics:
            metric.reset(first, context)

    def add(self, snapshot: Snapshot) -> None:
        """Count one more frame."""
        self.had_avs = self.had_avs or bool((snapshot.kind == Kind.AV).any())
        for metric in self._metrics:
            metric.add(snapshot)

    @property
    def offences(self) -> list[Offence]:
        """Offences of AVs so far, by time."""
        found = [o for metric in self._metrics if isinstance(metric, AvCounts) for o in metric.offences]
        return sorted(found, key=lambda o: o.time)

    def result(self) -> dict[str, Metric]:
        """Name -> figure with unit and better direction, in the table's order. Raises as `joined`."""
        figures: dict[str, Metric] = {}
        for metric in self._metrics:
            figures = joined(figures, metric.result(), code.place_of(metric))
        return figures


def joined(figures: Mapping[str, Metric], more: object, file: object = None) -> dict[str, Metric]:
    """`figures` and the figures `more` of another metric, with code in `file`.

    Raises BadInput unless it is a mapping of free names to `Metric`, each with a numeric value.
    """
    if not isinstance(more, Mapping):
        raise BadInput("must return a mapping of names to cosim.types.Metric", file=file, field="result")
    for name, figure in more.items():
        if name in figures or name in {*RESERVED, *COLUMNS}:
            raise BadInput("is the name of something else in a row", file=file, field="metric", value=name)
        if not isinstance(figure, Metric) or not isinstance(figure.value, Number | None):
            problem = "must be a cosim.types.Metric of a number, true, false or None"
            raise BadInput(problem, file=file, field=f"metric.{name}", value=figure)
    return {**figures, **more}


def read(what: str | MetricFactory, field: str = "--metric") -> MetricFactory:
    """The factory of a metric from FILE.py:NAME or MODULE:NAME; a class or factory is returned unchanged.

    `METRICS` are measured in any case. Raises BadInput when the code cannot be loaded.
    """
    if not isinstance(what, str):
        return what
    own = code.read(what, field)
    own.load(field)
    return partial(own.make, field)
