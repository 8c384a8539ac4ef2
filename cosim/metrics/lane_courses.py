"""A check of straight-line conflicts along lanes, which bend and diverge."""

from collections.abc import Iterable
from itertools import product
from typing import NamedTuple

import numpy as np

from cosim.geometry import Boxes, boxes, first_contacts, time_to_collision
from cosim.road import RoadMap
from cosim.types import Floats, Snapshot

MAX_LATER = 0.5  # s, largest delay of the contact along lanes after the straight-line contact
TIME_STEP = 0.1  # s between compared poses
LANE_REACH = 150.0  # m of lanes followed beyond the present one
STRAIGHT_BEYOND = 400.0  # m of straight extension beyond both ends of a path

Ways = set[tuple[frozenset[str], frozenset[str]]]  # pairs of paths of two vehicles, as sets of edges


class Way(NamedTuple):
    """A path: a lane and its successors."""

    edges: frozenset[str]
    line: Floats  # [p,3] lane position m, x m, y m


OFF_LANE = Way(frozenset(), np.zeros((0, 3)))  # of a vehicle off every lane


class LaneCourses:
    """Extrapolates vehicles along their lanes at constant speed and constant offset from the centre line."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self._known: dict[int, list[Way]] = {}  # by lane

    def meeting(self, s: Snapshot, i: int, j: int) -> Ways | None:
        """For vehicles `i` and `j` with a straight-line contact: the pairs of paths with a contact along the
        lanes, at most `MAX_LATER` s later; None if every pair has one.

        Vehicles on one edge may change lanes and always count. A vehicle off every lane goes straight on.
        """
        a, b = int(s.lane[i]), int(s.lane[j])
        if max(a, b) < 0 or (min(a, b) >= 0 and self._road.lanes[a].edge == self._road.lanes[b].edge):
            return None
        one, other = (boxes(s, np.array([row])) for row in (i, j))
        within = float(time_to_collision(one, other)[0]) + MAX_LATER
        times = np.arange(0.0, within, TIME_STEP)
        mine = self._courses(s, i, times)._replace(length=float(s.length[i]), width=float(s.width[i]))
        touch = first_contacts(mine, self._courses(s, j, times), TIME_STEP) < within  # [ways of i, ways of j]
        if touch.all():
            return None
        pairs = product(self._ways(a), self._ways(b))
        return {(p.edges, q.edges) for (p, q), met in zip(pairs, touch.ravel(), strict=True) if met}

    def still(self, ways: Ways, s: Snapshot, pair: Iterable[str]) -> Ways:
        """The subset of `ways` that is still possible from the present positions."""
        for k, name in enumerate(pair):
            row = s.row.get(name)
            if row is not None and (lane := int(s.lane[row])) >= 0:
                ways = {both for both in ways if self._road.lanes[lane].edge in both[k]}
        return ways

    def _courses(self, s: Snapshot, row: int, times: Floats) -> Boxes:
        """One vehicle on each of its paths: x, y, heading, speed [ways,t], length and width [ways]."""
        length, poses = float(s.length[row]), []
        if s.lane[row] < 0:
            alone = boxes(s, np.array([row]))
            course = np.array([np.cos(alone.heading), np.sin(alone.heading)])  # [2,1]
            x, y = np.array([alone.x, alone.y]) + course * alone.speed * times
            still = np.zeros_like(times)[None]
            return alone._replace(
                x=x[None], y=y[None], heading=alone.heading + still, speed=alone.speed + still
            )
        front = s.lane_position[row] + s.speed[row] * times
        for _, line in self._ways(int(s.lane[row])):
            nose, tail = (
                np.stack([np.interp(at, line[:, 0], line[:, k]) for k in (1, 2)])
                for at in (front, front - length)
            )  # [2,t] m
            heading = np.arctan2(nose[1] - tail[1], nose[0] - tail[0])
            left, centre = np.stack([-np.sin(heading), np.cos(heading)]), 0.5 * (nose + tail)
            aside = left[:, 0] @ (np.array([s.x[row], s.y[row]]) - centre[:, 0])  # m
            poses.append(np.vstack([centre + aside * left, heading]))
        x, y, heading = np.stack(poses, axis=1)
        sizes = np.full(len(x), length), np.full(len(x), s.width[row])
        return Boxes(x, y, heading, *sizes, np.full_like(x, s.speed[row]))

    def _ways(self, lane: int) -> list[Way]:
        if lane < 0:
            return [OFF_LANE]
        if lane not in self._known:
            self._known[lane] = [self._way(lanes) for lanes in self._sequences((lane,), 0.0)]
        return self._known[lane]

    def _sequences(self, lanes: tuple[int, ...], driven: float) -> list[tuple[int, ...]]:
        """All paths that begin with `lanes`, of which `driven` m are beyond the first lane."""
        road = self._road.lanes
        following = [k for k in road[lanes[-1]].successors if k not in lanes]
        if driven > LANE_REACH or not following:
            return [lanes]
        return [way for k in following for way in self._sequences((*lanes, k), driven + road[k].length)]

    def _way(self, lanes: tuple[int, ...]) -> Way:
        begin, parts = 0.0, []
        for k in lanes:
            lane = self._road.lanes[k]
            arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane.shape, axis=0).T))])
            parts.append(np.column_stack([begin + arc * (lane.length / max(arc[-1], 1e-3)), lane.shape]))
            begin += lane.length
        line = np.concatenate(parts)
        line = line[np.append(True, np.diff(line[:, 0]) > 1e-3)]
        ends = [line[0], line[-1]]
        if len(line) > 1:
            first, last = ((step / step[0]) for step in (line[1] - line[0], line[-1] - line[-2]))
            ends = [line[0] - STRAIGHT_BEYOND * first, line[-1] + STRAIGHT_BEYOND * last]
        return Way(frozenset(self._road.lanes[k].edge for k in lanes), np.vstack([ends[0], line, ends[1]]))
