"""Lanes whose vehicles can touch: vehicles on a bridge and below it overlap only on the map."""

from functools import cached_property

import numpy as np
import numpy.typing as npt

from cosim.arrays import Bools, Ints
from cosim.road.lane import Lane

MAX_ROAD_DISTANCE = 100.0  # m of road between two edges whose vehicles can touch


class Contact:
    """Contact between places: lanes (indices into RoadMap.lanes), or -2 - k for edge k without a lane.

    Vehicles can touch if one edge is reached from the other within `MAX_ROAD_DISTANCE` (either way), or if
    one vehicle is off every edge. Edges closed to motor vehicles (`closed`: one lane of each) can be reached
    but lead nowhere, so that a footpath does not join a bridge to the road below it. `table` [S,S] holds the
    answers for the edges queried so far; `numbers` gives the row of each place.
    """

    def __init__(self, lanes: tuple[Lane, ...], closed: tuple[Lane, ...] = ()) -> None:
        first: dict[str, Lane] = {}
        for lane in (*lanes, *closed):
            first.setdefault(lane.edge, lane)
        self.edges: dict[str, int] = {edge: k for k, edge in enumerate(first)}
        self._lanes, self._closed = (*lanes, *closed), frozenset(lane.edge for lane in closed)
        self._first = tuple(first.values())
        count = len(first)
        numbered = [self.edges[lane.edge] for lane in lanes]
        # [l + count + 1] negative places count from the end: -1 is off every edge, -2 edge 0, -3 edge 1
        self._edge: Ints = np.array([*numbered, *reversed(range(count)), count], np.int64)
        self._number: Ints = np.full(count + 1, -1, np.int64)  # row of every edge, -1: none yet
        self._members: list[int] = []  # edges with a row
        self.table: Bools = np.zeros((16, 16), np.bool_)

    def edge(self, place: int) -> str:
        """The edge of a place, "" off every edge."""
        return "" if place == -1 else self._first[self._edge[place]].edge

    def numbers(self, place: npt.NDArray[np.integer]) -> Ints:
        """[n] places -> [n] rows of `table` (which may grow: read it afterwards)."""
        edge = self._edge[place]
        found: Ints = self._number[edge]
        if len(found) and found.min() < 0:
            for k in np.flatnonzero(found < 0):
                self._meet(int(edge[k]))
            found = self._number[edge]
        return found

    def touch(self, lane: int, others: npt.NDArray[np.integer]) -> Bools:
        """[n] whether vehicles on the lanes `others` [n] can touch one on `lane`."""
        rows = self.numbers(np.append(others, lane))
        return np.asarray(self.table[rows[-1], rows[:-1]])

    def _meet(self, edge: int) -> None:
        if self._number[edge] >= 0:
            return
        everywhere = len(self._first)  # pseudo-edge of place -1
        near = None if edge == everywhere else self._edges_near(self._first[edge])  # None: all
        new = self._number[edge] = len(self._members)
        self._members.append(edge)
        if new == len(self.table):
            self.table = np.pad(self.table, (0, new))
        for k, other in enumerate(self._members):
            touch = near is None or other == everywhere or self._first[other].edge in near
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
        """The edges within `MAX_ROAD_DISTANCE` of the lane's edge, including that edge."""
        found, seen = {lane.edge}, {lane.start: 0.0, lane.end: 0.0}
        waiting = [lane.start, lane.end]
        while waiting:
            junction = waiting.pop()
            for other in self._at.get(junction, ()):
                found.add(other.edge)
                if other.edge in self._closed:
                    continue
                far = other.end if other.start == junction else other.start
                distance = seen[junction] + other.length
                if distance < min(MAX_ROAD_DISTANCE, seen.get(far, np.inf)):
                    seen[far] = distance
                    waiting.append(far)
        return found
