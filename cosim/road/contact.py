"""Which roads can touch: vehicles on a bridge and below it are on top of one another only on the map."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from cosim.arrays import Bools, Ints
from cosim.road.lane import Lane

REACH = 100.0  # m of road between two edges, within which vehicles on them may meet
OFF = -1  # the lane of a vehicle that is off every lane: it may be anywhere


class Contact:
    """Answers for lanes (indices into RoadMap.lanes), worked out per pair of edges when first asked.

    Vehicles can touch when one's edge is reached from the other's within `REACH` m of road (either way), and
    when one of them is off every lane. `table` [S,S] holds the answers for the edges met so far; `numbers`
    gives each lane's place in it.
    """

    def __init__(self, lanes: tuple[Lane, ...]) -> None:
        self._lanes = lanes
        edges: dict[str, int] = {}
        numbered = [edges.setdefault(lane.edge, len(edges)) for lane in lanes]
        self._edge: Ints = np.array([*numbered, len(edges)], np.int64)  # [l+1], the last for OFF
        self._number: Ints = np.full(len(edges) + 1, -1, np.int64)  # of every edge, -1 not met yet
        self._members: list[int] = []  # a lane of every edge met
        self.table: Bools = np.zeros((16, 16), np.bool_)

    def numbers(self, lane: npt.NDArray[np.integer]) -> Ints:
        """[n] lanes -> [n] rows of `table` (which may grow: read it afterwards)."""
        found: Ints = self._number[self._edge[lane]]
        if len(found) and found.min() < 0:
            for k in np.flatnonzero(found < 0):
                self._meet(int(lane[k]))
            found = self._number[self._edge[lane]]
        return found

    def touch(self, lane: int, others: npt.NDArray[np.integer]) -> Bools:
        """[n] whether vehicles on the lanes `others` [n] can touch one on `lane`."""
        rows = self.numbers(np.append(others, lane))
        return np.asarray(self.table[rows[-1], rows[:-1]])

    def _meet(self, lane: int) -> None:
        edge = self._edge[lane]
        if self._number[edge] >= 0:
            return
        near = None if lane == OFF else self._edges_near(self._lanes[lane])  # None: all
        new = self._number[edge] = len(self._members)
        self._members.append(lane)
        if new == len(self.table):
            self.table = np.pad(self.table, (0, new))
        for k, other in enumerate(self._members):
            touch = near is None or other == OFF or self._lanes[other].edge in near
            self.table[new, k] = self.table[k, new] = touch

    @cached_property
    def _at(self) -> dict[str, list[Lane]]:
        """Junction -> the lanes that begin or end there."""
        found: dict[str, list[Lane]] = {}
        for lane in self._lanes:
            for junction in (lane.start, lane.end):
                found.setdefault(junction, []).append(lane)
        return found

    def _edges_near(self, lane: Lane) -> set[str]:
        """The edges reached from the lane's within `REACH` m of road, its own among them."""
        found, seen = {lane.edge}, {lane.start: 0.0, lane.end: 0.0}
        waiting = [lane.start, lane.end]
        while waiting:
            junction = waiting.pop()
            for other in self._at.get(junction, ()):
                found.add(other.edge)
                far = other.end if other.start == junction else other.start
                distance = seen[junction] + other.length
                if distance < min(REACH, seen.get(far, np.inf)):
                    seen[far] = distance
                    waiting.append(far)
        return found
