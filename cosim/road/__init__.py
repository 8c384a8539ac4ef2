"""The road as pure data: lanes with centre lines, their connections, and the paths ahead of a vehicle."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cosim.arrays import Floats, Ints
from cosim.road.contact import Contact
from cosim.road.lane import Lane as Lane
from cosim.road.link import Crossing as Crossing
from cosim.road.link import Link as Link
from cosim.road.link import Rule as Rule

MAX_CACHED_PATHS = 20_000  # in a city every vehicle has a new route ahead on every edge
PATH_HORIZON = 400.0  # m: longer than junction arms and than any distance driven in the 4 s horizon


@dataclass(frozen=True, eq=False)
class LanePath:
    """A lane's centre line, continued through its successors; one object per path (`RoadMap.path`).

    `arc` is 0 at the beginning of the first lane; SUMO lane positions are scaled to it.
    """

    points: Floats  # [p,2] m
    arc: Floats  # [p] m, distance along `points`
    lanes: tuple[int, ...]  # lanes passed, in order
    lane_start: Floats  # [len(lanes)] m, arc where each lane begins
    dead_end: bool  # the path ends where the lane, or its use for this route, ends
    leaves: bool  # the path ends where the route ends (the vehicle arrives)
    scale: float  # arc length per SUMO lane position on the first lane
    conflict: float  # m, arc where the conflict zone begins; inf for a path through none

    @property
    def length(self) -> float:
        """m"""
        return float(self.arc[-1])

    @cached_property
    def next_lanes(self) -> Ints:
        """The first three lanes, or fewer on a short path."""
        return np.array(self.lanes[:3], np.int64)

    def pose(self, arc: Floats) -> tuple[Floats, Floats, Floats]:
        """Positions and headings at arc lengths. [k] m -> x [k] m, y [k] m, heading [k] rad.

        Beyond either end the path is extended straight.
        """
        a = np.asarray(arc, dtype=np.float64)
        i = np.clip(np.searchsorted(self.arc, a, side="right") - 1, 0, len(self.arc) - 2)
        d = self.points[i + 1] - self.points[i]  # [k,2]
        span = np.maximum(self.arc[i + 1] - self.arc[i], 1e-9)
        s = ((a - self.arc[i]) / span)[:, None]
        p = self.points[i] + s * d
        return p[:, 0], p[:, 1], np.arctan2(d[:, 1], d[:, 0])


class RouteAhead(NamedTuple):
    """An AV's own route knowledge at one decision (contract, Observation)."""

    paths: tuple[LanePath | None, LanePath | None, LanePath | None]  # left, keep, right; None: no lane
    arc: float  # m, position of the vehicle's centre along every path
    conflict_distance: float  # m to the conflict zone along the present lane; inf: none ahead
    speed_limit: float  # m/s

    def to_end(self, side: int) -> float:
        """m to the dead end of a path; inf without one (side 0 left, 1 keep, 2 right)."""
        path = self.paths[side]
        if path is None:
            return 0.0
        return path.length - self.arc if path.dead_end else float("inf")


@dataclass(frozen=True)
class ConflictZone:
    """Lanes on which traffic streams conflict (indices into RoadMap.lanes)."""

    name: str
    lanes: frozenset[int]


class LaneGraph(NamedTuple):
    """The default successor of every lane, for fast lookahead; l lanes as in RoadMap.lanes."""

    following: Ints  # [l] successor, -1 at the end
    length: Floats  # [l] m


@dataclass(frozen=True)
class RoadMap:
    """Every lane of a net. Paths are cached, and equal paths share one object."""

    lanes: tuple[Lane, ...]
    zones: tuple[ConflictZone, ...] = ()
    junctions: tuple[Floats, ...] = ()  # [p,2] m, outlines
    links: tuple[Link, ...] = ()  # every connection from a lane into a junction
    signals: tuple[
        tuple[str, int], ...
    ] = ()  # (traffic light, its link index) of every entry of `Snapshot.signals`
    crossings: tuple[Crossing, ...] = ()
    closed: tuple[Lane, ...] = ()  # one lane of every edge closed to motor vehicles
    _paths: dict[tuple[int, tuple[str, ...] | None], LanePath] = field(default_factory=dict, repr=False)
    _ways: dict[tuple[tuple[int, ...], bool, bool], LanePath] = field(default_factory=dict, repr=False)
    index: dict[str, int] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self.index.update({lane.id: i for i, lane in enumerate(self.lanes)})

    def path(self, lane: int, route: tuple[str, ...] | None = None) -> LanePath:
        """The path ahead from the start of `lane`.

        `route`: edges from the lane's own edge on, without internal edges. The path follows the route and
        dead-ends where the lane does not continue it. Without a route (unknown for other vehicles), the path
        follows the straightest successors.
        """
        key = (lane, route)
        found = self._paths.get(key)
        if found is None:
            if len(self._paths) >= MAX_CACHED_PATHS:
                self._paths.clear()
            way = self._follow(lane, route)
            if way not in self._ways:
                self._ways[way] = self._join(*way)
            found = self._paths[key] = self._ways[way]
        return found

    @cached_property
    def link_of(self) -> dict[tuple[int, int], int]:
        """(lane before the stop line, internal or target lane) -> index of the link."""
        found: dict[tuple[int, int], int] = {}
        for k, link in enumerate(self.links):
            found[link.origin, link.target] = k
            if link.via >= 0:
                found[link.origin, link.via] = k
        return found

    @cached_property
    def contact(self) -> Contact:
        """Lanes whose vehicles can touch: not those on a bridge and below it."""
        return Contact(self.lanes, self.closed)

    def connected(self, a: int, b: int) -> bool:
        """Whether vehicles on lanes or places (`Snapshot.place`) `a` and `b` can touch; -1: with all."""
        return bool(self.contact.touch(a, np.array([b]))[0])

    def waits_inside(self, lane: int) -> bool:
        """Whether the lane ends at a waiting position inside the junction (SUMO's internal junctions)."""
        lanes = self.lanes
        return lane >= 0 and lanes[lane].internal and any(lanes[k].internal for k in lanes[lane].successors)

    @cached_property
    def before(self) -> tuple[tuple[int, ...], ...]:
        """The lanes that lead directly into each lane."""
        found: list[list[int]] = [[] for _ in self.lanes]
        for k, lane in enumerate(self.lanes):
            for following in lane.successors:
                found[following].append(k)
        return tuple(map(tuple, found))

    @cached_property
    def lanes_of(self) -> dict[str, tuple[int, ...]]:
        """Edge -> its lanes."""
        found: dict[str, tuple[int, ...]] = {}
        for k, lane in enumerate(self.lanes):
            found[lane.edge] = (*found.get(lane.edge, ()), k)
        return found

    @cached_property
    def links_through(self) -> dict[int, tuple[int, ...]]:
        """Internal lane -> the links (indices) over this lane."""
        found: dict[int, tuple[int, ...]] = {}
        for number, lanes in enumerate(self.inside):
            for lane in lanes:
                found[lane] = (*found.get(lane, ()), number)
        return found

    @cached_property
    def inside(self) -> tuple[tuple[int, ...], ...]:
        """The internal lanes of each link, in driving order."""
        found = []
        for link in self.links:
            ways: list[int] = []
            lane = link.via
            while lane >= 0 and self.lanes[lane].internal and lane not in ways:
                ways.append(lane)
                lane = next(iter(self.lanes[lane].successors), -1)
            found.append(tuple(ways))
        return tuple(found)

    @cached_property
    def straight_on(self) -> LaneGraph:
        """The straightest successor of every lane, for vehicles with an unknown route."""
        steps = [self._successor(k, None, 0) for k in range(len(self.lanes))]
        following = np.array([-1 if step is None else step[0] for step in steps], np.int64)
        return LaneGraph(following, np.array([lane.length for lane in self.lanes], np.float64))

    def ahead(self, lane: int, lane_position: float, length: float, route: tuple[str, ...]) -> RouteAhead:
        """Route knowledge of a vehicle of `length` m with its front bumper at `lane_position` m of `lane`."""
        here = self.lanes[lane]
        keep = self.path(lane, route)
        left = None if here.left < 0 else self.path(here.left, route)
        right = None if here.right < 0 else self.path(here.right, route)
        arc = (lane_position - 0.5 * length) * keep.scale
        conflict = max(keep.conflict - arc - 0.5 * length, 0.0)
        return RouteAhead((left, keep, right), arc, conflict, here.speed_limit)

    @cached_property
    def _lengths(self) -> list[float]:
        """Every lane's length along its centre line, m (`Lane.length` is SUMO's)."""
        return [float(np.sqrt((np.diff(lane.shape, axis=0) ** 2).sum(1)).sum()) for lane in self.lanes]

    @cached_property
    def _exits(self) -> list[float]:
        """Every lane's heading at its end, rad."""
        last = [lane.shape[-1] - lane.shape[-2] for lane in self.lanes]
        return [float(np.arctan2(d[1], d[0])) for d in last]

    def _follow(self, first: int, route: tuple[str, ...] | None) -> tuple[tuple[int, ...], bool, bool]:
        """The lanes of a path, whether it has a dead end, and whether it ends with the route."""
        lanes = [first]
        total = self._lengths[first]
        place = 0  # index into the route
        dead_end = leaves = False
        while total < PATH_HORIZON + self._lengths[first]:
            lane = self.lanes[lanes[-1]]
            if route is not None and place >= len(route) - 1 and not lane.internal:
                leaves = True
                break
            step = self._successor(lanes[-1], route, place)
            if step is None:
                beside = [self.lanes[o] for o in (lane.left, lane.right) if o >= 0]
                dead_end = route is not None or any(other.successors for other in (lane, *beside))
                leaves = not dead_end
                break
            following, place = step
            if following in lanes:  # a ring: stop after one round
                break
            lanes.append(following)
            total += self._lengths[following]
        return tuple(lanes), dead_end, leaves

    def _successor(self, index: int, route: tuple[str, ...] | None, place: int) -> tuple[int, int] | None:
        lane = self.lanes[index]
        if not lane.successors:
            return None
        if route is None:
            return min(lane.successors, key=lambda s: abs(_wrap(self._exits[s] - self._exits[index]))), place
        fitting = self._fitting(lane, route, place)
        if not fitting:
            return None
        best = fitting[0]
        if len(fitting) > 1:  # the road widens: as in SUMO, the lane that follows the route furthest
            best = max(fitting, key=lambda s: self._reach(s, route, self._place_on(s, place), 300.0))
        return best, self._place_on(best, place)

    def _fitting(self, lane: Lane, route: tuple[str, ...], place: int) -> list[int]:
        """Successors that lead to the next edge of the route."""
        wanted = route[place + 1] if place + 1 < len(route) else None
        return [s for s in lane.successors if self._leads_to(s, wanted)]

    def _place_on(self, lane: int, place: int) -> int:
        return place if self.lanes[lane].internal else place + 1

    def _reach(self, lane: int, route: tuple[str, ...], place: int, left: float) -> float:
        """m of the next `left` m of the route that are drivable from the start of `lane`."""
        here = self.lanes[lane]
        own = self._lengths[lane]
        if own >= left or (place >= len(route) - 1 and not here.internal):
            return left
        further = (
            self._reach(s, route, self._place_on(s, place), left - own)
            for s in self._fitting(here, route, place)
        )
        return own + max(further, default=0.0)

    def _leads_to(self, lane: int, edge: str | None) -> bool:
        """Whether the lane is on `edge`, or is an internal lane that leads there."""
        seen = 0
        while self.lanes[lane].internal and self.lanes[lane].successors and seen < 8:
            lane = self.lanes[lane].successors[0]
            seen += 1
        return self.lanes[lane].edge == edge

    def _join(self, indices: tuple[int, ...], dead_end: bool, leaves: bool) -> LanePath:
        starts = np.cumsum([0.0, *(self._lengths[i] for i in indices[:-1])])  # m
        shapes = [self.lanes[i].shape for i in indices]
        points = np.concatenate([shapes[0], *(shape[1:] for shape in shapes[1:])])
        step = np.sqrt((np.diff(points, axis=0) ** 2).sum(1))
        keep = np.concatenate([[True], step > 1e-6])
        if keep.sum() < 2:
            keep[-1] = True
        points = points[keep]
        arc = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(points, axis=0) ** 2).sum(1)))])
        conflict = [
            start
            for start, i in zip(starts.tolist(), indices, strict=True)
            if any(i in z.lanes for z in self.zones)
        ]
        first = self.lanes[indices[0]]
        return LanePath(
            points,
            arc,
            indices,
            starts,
            dead_end,
            leaves,
            scale=self._lengths[indices[0]] / max(first.length, 1e-6),
            conflict=min(conflict, default=np.inf),
        )


def _wrap(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
