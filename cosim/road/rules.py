"""Traffic rules ahead on a vehicle's path: signals, stop lines, right of way, crossings, speed limits."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping
from itertools import pairwise
from types import MappingProxyType
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from cosim.arrays import Bytes, Floats
from cosim.road import PATH_HORIZON, Crossing, LanePath, Link, RoadMap, Rule

RED, YELLOW, GREEN = "ru", "yY", "gG"  # a signal's states (SUMO, Simulation/Traffic_Lights)
COMFORT_DECEL = 3.0  # m/s2: yellow must be obeyed if this deceleration suffices (figures.md, The law)
STOP_STATES = "s"  # the green arrow: stop, then yield
YIELD_STATES = "gos"  # green without priority, off and blinking, the green arrow
STOP_SIGNS = (Rule.STOP, Rule.ALL_WAY_STOP)
WAITING_ZONE = 2.0  # m beyond a crossing's end, in which a person waits for the crossing
STANDSTILL = 0.1  # m/s, of a person
ENTRY_COSINE = 0.5  # a person walking within 60 degrees of the crossing's direction will enter
SAMPLE_SPACING = 0.25  # m, resolution of a crossing's position along a lane
UNCHANGED: Mapping[int, float] = MappingProxyType({})  # no variable speed limits
_GRID = 16.0  # m, cell size of the spatial index of persons


def no_limits() -> Floats:
    """[1,2] the limits ahead of a vehicle with an unknown path."""
    return np.array([[0.0, np.inf]])


class RulesAhead(NamedTuple):
    """The traffic rules on one vehicle's path at one time (docs/reference/observation.md).

    Distances in m from the front bumper along `RouteAhead.paths[1]`; inf: none within `PATH_HORIZON` or
    before the path's dead end. For the lanes that serve the route, see `RouteAhead.to_end`.
    """

    signal: str = ""  # state of the next signal, one of rRyYgGosu; "": none ahead
    signal_distance: float = math.inf  # m to its stop line
    signal_index: int = -1  # into `RoadMap.signals`
    switch_in: float = -1.0  # s to the next phase of the traffic light; -1 without `signal_timing`
    stop_distance: float = math.inf  # m to the next line with a stop sign or green arrow
    all_way_stop: bool = False  # whether that line belongs to an all-way stop
    yield_distance: float = math.inf  # m to the next yield line
    yield_link: int = -1  # its index into `RoadMap.links`; `foes` are the links with right of way
    crossing_distance: float = math.inf  # m to the near edge of the next pedestrian crossing; 0 on it
    person_distance: float = math.inf  # m to the next crossing with a person on it or waiting
    limits: Floats = no_limits()  # [k,2] m and m/s: start of each limit, the present one at 0 m


NO_RULES = RulesAhead()


class Moment:
    """The time-dependent part of the rules: signal states, persons and variable limits."""

    def __init__(
        self,
        signals: Bytes | None = None,
        switches: Floats | None = None,
        persons: Floats | None = None,
        limits: Mapping[int, float] = UNCHANGED,
    ) -> None:
        """Take the state of all signals.

        Args:
            signals: [s] `ord` of every signal's state in the order of `RoadMap.signals`; None: unknown, so
                that every line has its rule without signals.
            switches: [s] s until the next phase of every signal's traffic light; None: unknown.
            persons: [p,4] x m, y m, heading rad, speed m/s of the perceived persons.
            limits: lane -> m/s, limits that differ from the road map.
        """
        self.limits = limits
        self.states = "" if signals is None else signals.tobytes().decode("latin-1")
        self.switches = switches
        self.taken: dict[int, bool] = {}  # cache: crossing -> occupied
        self.persons: dict[tuple[int, int], list[list[float]]] = {}  # by cell of `_GRID` m
        if persons is not None:
            squares = np.floor(persons[:, :2] / _GRID).astype(int).tolist()
            for (column, row), person in zip(squares, persons.tolist(), strict=True):
                self.persons.setdefault((column, row), []).append(person)


class _Way(NamedTuple):
    """The static rules along one path: arcs in m from its start, in order."""

    lines: tuple[tuple[float, int, Link], ...]  # (arc, index of the link, the link)
    crossings: tuple[tuple[float, float, int], ...]  # (arc of the near edge, of the far edge, index)
    limits: Floats  # [k,2] arc, m/s: changes of the limit
    starts: list[float]  # the arcs of `limits`


class RuleBook:
    """The traffic rules of one road map. Static rules are cached per path."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self._ways: WeakKeyDictionary[LanePath, _Way] = WeakKeyDictionary()
        self._crossings = [_Zebra(c) for c in road.crossings]
        self._crossed: dict[int, list[int]] = {}  # lane -> the crossings over it
        for number, crossing in enumerate(road.crossings):
            for lane in crossing.lanes:
                self._crossed.setdefault(lane, []).append(number)

    def ahead(self, path: LanePath, front: float, now: Moment) -> RulesAhead:
        """The rules for a vehicle on the first lane of `path`, with its front bumper at arc `front` m."""
        way = self._ways.get(path)
        if way is None:
            way = self._ways[path] = self._survey(path)
        states, horizon = now.states, front + PATH_HORIZON
        signal, signal_at, signal_index = "", math.inf, -1
        stop_at, all_way, yield_at, yield_link = math.inf, False, math.inf, -1
        for arc, number, link in way.lines:
            if arc > horizon:
                break
            state = states[link.signal : link.signal + 1]
            if state and signal_index < 0:
                signal, signal_at, signal_index = state, max(arc - front, 0.0), link.signal
            if stop_at == math.inf and (state in STOP_STATES if state else link.rule in STOP_SIGNS):
                stop_at = max(arc - front, 0.0)
                all_way = not state and link.rule == Rule.ALL_WAY_STOP
            if yield_link < 0 and (state in YIELD_STATES if state else link.rule != Rule.PRIORITY):
                yield_at, yield_link = max(arc - front, 0.0), number
        crossing_at = person_at = math.inf
        for near, far, number in way.crossings:
            if near > horizon:
                break
            if far < front:
                continue
            distance = max(near - front, 0.0)
            crossing_at = min(crossing_at, distance)
            if not now.persons:
                break
            if self._taken(number, now):
                person_at = distance
                break
        begin, starts = way.limits, way.starts
        if now.limits and not now.limits.keys().isdisjoint(path.lanes):
            begin, starts = self._limits(path, now.limits)
        limits = begin[: bisect_left(starts, horizon)].copy()
        limits[:, 0] -= front
        limits[0, 0] = 0.0
        switch = -1.0
        if signal_index >= 0 and now.switches is not None:
            switch = float(now.switches[signal_index])
        return RulesAhead(
            *(signal, signal_at, signal_index, switch, stop_at, all_way, yield_at, yield_link),
            *(crossing_at, person_at, limits),
        )

    def _taken(self, number: int, now: Moment) -> bool:
        """Whether a person is on the crossing, or waits there without a red signal."""
        taken = now.taken.get(number)
        if taken is None:
            zebra = self._crossings[number]
            red = now.states[zebra.signal : zebra.signal + 1] == "r"
            near = (person for square in zebra.squares for person in now.persons.get(square, ()))
            taken = now.taken[number] = any(zebra.holds(person, red) for person in near)
        return taken

    def _survey(self, path: LanePath) -> _Way:
        road, starts = self._road, path.lane_start.tolist()
        lines = []
        for place, pair in enumerate(pairwise(path.lanes), 1):
            number = road.link_of.get(pair)
            if number is not None:
                lines.append((starts[place], number, road.links[number]))
        crossings = []
        for start, lane in zip(starts, path.lanes, strict=True):
            for number in self._crossed.get(lane, ()):
                near, far = self._crossings[number].place_on(road.lanes[lane].shape)
                crossings.append((start + near, start + far, number))
        return _Way(tuple(lines), tuple(sorted(crossings)), *self._limits(path, UNCHANGED))

    def _limits(self, path: LanePath, changed: Mapping[int, float]) -> tuple[Floats, list[float]]:
        """`_Way.limits` and `_Way.starts`, with the `changed` limits."""
        limits: list[tuple[float, float]] = []
        for start, lane in zip(path.lane_start.tolist(), path.lanes, strict=True):
            limit = changed.get(lane, self._road.lanes[lane].speed_limit)
            if not limits or limit != limits[-1][1]:
                limits.append((start, limit))
        return np.array(limits), [arc for arc, _ in limits]


class _Zebra:
    """The geometry of a pedestrian crossing."""

    def __init__(self, crossing: Crossing) -> None:
        ends = crossing.shape.tolist()
        self.signal, self._half, self._crossing = crossing.signal, 0.5 * crossing.width, crossing
        self._pieces = []  # of the centre line: x m, y m, direction, length m, extension before and after, m
        for k, ((ax, ay), (bx, by)) in enumerate(pairwise(ends)):
            length = max(math.hypot(bx - ax, by - ay), 1e-6)
            before, after = WAITING_ZONE * (k == 0), WAITING_ZONE * (k == len(ends) - 2)
            self._pieces.append((ax, ay, (bx - ax) / length, (by - ay) / length, length, before, after))
        margin = self._half + WAITING_ZONE
        low, high = (
            np.floor((edge + d) / _GRID).astype(int).tolist()
            for edge, d in ((crossing.shape.min(0), -margin), (crossing.shape.max(0), margin))
        )
        columns, rows = (range(a, b + 1) for a, b in zip(low, high, strict=True))
        self.squares = [(column, row) for column in columns for row in rows]

    def holds(self, person: list[float], red: bool) -> bool:
        """Whether the person is on the crossing, or waits or enters there while its signal is not `red`."""
        x, y, heading, speed = person
        for ax, ay, ux, uy, length, before, after in self._pieces:
            along, across = (x - ax) * ux + (y - ay) * uy, (y - ay) * ux - (x - ax) * uy
            if abs(across) > self._half or not -before <= along <= length + after:
                continue
            if 0.0 <= along <= length:
                return True
            inwards = math.cos(heading) * ux + math.sin(heading) * uy  # cosine to the centre line
            if not red and (speed < STANDSTILL or (inwards if along < 0.0 else -inwards) > ENTRY_COSINE):
                return True
        return False

    def place_on(self, lane: Floats) -> tuple[float, float]:
        """Entry and exit of the crossing along the centre line [p,2] of a lane, m."""
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane, axis=0).T))])
        at = np.arange(0.0, arc[-1] + SAMPLE_SPACING, SAMPLE_SPACING)
        x, y = np.interp(at, arc, lane[:, 0]), np.interp(at, arc, lane[:, 1])
        distance = self._crossing.away(x, y)
        inside = np.flatnonzero(distance <= max(self._half, float(distance.min())))
        return float(at[inside[0]]), float(at[inside[-1]])
