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
HORIZON = 10.0  # s, further ahead straight-line extrapolation says nothing (docs/reference/paper_map.md)
CRITICAL = 1.5  # s, the usual bound of a serious conflict (van der Horst 1990); critical_th of P
HARD = 3.35  # m/s2, of the DRAC: above it a crossing or following is a conflict (Archer 2005)


class ConflictView:
    """The conflicts of a frame, worked out once for all the metrics that look at them.

    Vehicles on roads that cannot touch (a bridge and what passes below it) have none with each other.
    """

    def __init__(self, road: RoadMap, guessed: bool = False) -> None:
        self._contact = road.contact
        self._guessed = guessed
        self._snapshot: Snapshot | None = None

    def of(self, snapshot: Snapshot) -> Conflicts:
        """Of AVs and mission vehicles with any vehicle, up to `HORIZON` ahead; of all the grave ones."""
        if snapshot is not self._snapshot:
            roads = self._contact.numbers(snapshot.place), self._contact.table
            mine = watched(snapshot, self._guessed)
            self._conflicts = conflicts(boxes(snapshot), mine, HORIZON, roads, soon=CRITICAL, hard=HARD)
            self._snapshot = snapshot
        return self._conflicts


@dataclass(frozen=True)
class MetricContext:
    """The episode's frame: road, clocks, and what the mission vehicle is to reach."""

    road: RoadMap
    timing: Timing
    mission_kind: str  # merge, exit, roundabout, intersection, auto or none
    goal: frozenset[int]  # lanes (indices into RoadMap.lanes) on which the mission has succeeded
    duration: float  # s, counted
    mission_guessed: bool = False  # nobody named the mission vehicle: it counts in its own figures alone
    ends: bool = False  # a crash ends the episode before its time

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
        """A new episode; `first` is its first frame (time 0 of the counted time)."""

    def add(self, snapshot: Snapshot) -> None:
        """The next frame; `snapshot.events` hold what happened since the frame before."""

    def result(self) -> dict[str, Metric]:
        """Name -> figure, so far; NA is None."""


def watched(snapshot: Snapshot, guessed: bool = False) -> Bools:
    """[n] the vehicles whose conflicts are counted: AVs and mission vehicles that are not `guessed`."""
    avs = snapshot.kind == AV
    return np.asarray(avs if guessed else avs | snapshot.mission)


@compiled
def slow(kind: npt.NDArray[np.int8], speed: Floats, wanted: int, below: float) -> int:
    """How many of a kind are slower than `below` m/s."""
    found = 0
    for k in range(len(kind)):
        if kind[k] == wanted and speed[k] < below:
            found += 1
    return found
