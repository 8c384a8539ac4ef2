"""The context of an episode's metrics, and the protocol of a metric."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cosim.geometry import Conflicts, boxes, conflicts
from cosim.geometry.compiled import compiled
from cosim.metrics.everybody import Everybody
from cosim.metrics.lane_courses import LaneCourses
from cosim.road import RoadMap
from cosim.types import Bools, Floats, Kind, Metric, Snapshot, Timing

AV = int(Kind.AV)  # comparing arrays with an IntEnum member costs five times as much
PERSON = int(Kind.PERSON)
HORIZON = 10.0  # s, limit of a meaningful straight-line extrapolation (docs/reference/paper_map.md)
CRITICAL = 1.5  # s, the usual bound of a serious conflict (van der Horst 1990); critical_th of P
HARD_DRAC = 3.35  # m/s2, DRAC of a conflict in crossing or following (Archer 2005)


class ConflictView:
    """The conflicts of a frame, computed once for all metrics.

    Vehicles on roads that cannot touch (a bridge and the road below) have no conflicts with each other.
    """

    def __init__(self, road: RoadMap, guessed: bool = False) -> None:
        self._contact = road.contact
        self._guessed = guessed
        self._snapshot: Snapshot | None = None

    def of(self, snapshot: Snapshot) -> Conflicts:
        """Conflicts of AVs and mission vehicles with any vehicle up to `HORIZON`; critical ones of all."""
        if snapshot is not self._snapshot:
            roads = self._contact.numbers(snapshot.place), self._contact.table
            mine = watched(snapshot, self._guessed)
            self._conflicts = conflicts(boxes(snapshot), mine, HORIZON, roads, soon=CRITICAL, hard=HARD_DRAC)
            self._snapshot = snapshot
        return self._conflicts


@dataclass(frozen=True)
class MetricContext:
    """The context of an episode's metrics: road, clocks, and the mission's goal."""

    road: RoadMap
    timing: Timing
    mission_kind: str  # merge, exit, roundabout, intersection, auto or none
    goal: frozenset[int]  # lanes (indices into RoadMap.lanes) that fulfil the mission
    duration: float  # s, counted
    mission_guessed: bool = False  # automatically chosen mission vehicle: counts in its own figures only
    ends: bool = False  # whether a crash ends the episode early

    @cached_property
    def courses(self) -> LaneCourses:
        """Shared by the metrics of one episode."""
        return LaneCourses(self.road)

    @cached_property
    def conflicts(self) -> ConflictView:
        """Shared by the metrics of one episode."""
        return ConflictView(self.road, self.mission_guessed)

    @cached_property
    def everybody(self) -> Everybody:
        """Shared by the metrics of one episode."""
        return Everybody(self.duration, self.ends)


class EpisodeMetric(Protocol):
    """One figure or a few of an episode, computed from its frames."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        """Start an episode; `first` is its first frame (time 0 of the counted time)."""

    def add(self, snapshot: Snapshot) -> None:
        """Add the next frame; `snapshot.events` are the events since the previous frame."""

    def result(self) -> dict[str, Metric]:
        """Name -> figure, so far; NA is None."""


def watched(snapshot: Snapshot, guessed: bool = False) -> Bools:
    """[n] vehicles with counted conflicts: AVs, and mission vehicles unless `guessed`."""
    avs = snapshot.kind == AV
    return np.asarray(avs if guessed else avs | snapshot.mission)


@compiled
def slow(kind: npt.NDArray[np.int8], speed: Floats, wanted: int, below: float) -> int:
    """Number of vehicles of a kind slower than `below` m/s."""
    found = 0
    for k in range(len(kind)):
        if kind[k] == wanted and speed[k] < below:
            found += 1
    return found
