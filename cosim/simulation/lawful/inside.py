"""Conflicts of an AV inside a junction, or before one.

Inside a junction, SUMO's driver respects the vehicles with priority only. It starts into vehicles that pass,
or that stand partly across its way where the network makes them wait
(https://sumo.dlr.de/docs/Simulation/Intersections.html, "Waiting within the intersection"). This module
checks every vehicle that is in the junction in part, or soon will be, and persons that walk there.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence, Set
from functools import cached_property
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np

from cosim.geometry import Boxes, overlap
from cosim.road import LanePath, RoadMap
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.conventions import centres
from cosim.simulation.eyes import Eyes
from cosim.types import Floats

STOPPING_DECEL = 4.5  # m/s2 of a slow vehicle that comes to a stop
SLOW_SPEED = 3.0  # m/s: a faster vehicle is taken to drive on
WAITING_MARGIN = 0.1  # m before the end of a lane, where SUMO's drivers wait inside a junction
SPACING = 0.25  # m between two poses of a path
STANDING_MARGIN = np.array([[0.0], [0.0], [0.0], [0.0], [0.2]])  # m of extra width before the AV starts
STANDING_SPEED = 0.5  # m/s: a slower vehicle counts as standing
PERSON_WIDTH = 0.5  # m, a person's length and width
OFFSET_STEP = 0.1  # m between two lateral offsets
SWERVE_RATE = 0.2  # m to the side per m driven
ENTRY_HORIZON = 3.0, 10.0  # s, or m, to a green line, within which a vehicle will soon be inside


class WayOut(NamedTuple):
    """An AV's way out of a junction."""

    distance: float  # m that the AV can drive; inf: all of the way
    blockers: tuple[str, ...] = ()  # standing vehicles in the way
    offset: float = 0.0  # m to the left of the lane's centre line, past the blockers


CLEAR = WayOut(math.inf)


class Inside:
    """The interiors of the junctions of `road`, as seen with the AVs' `eyes`."""

    def __init__(self, road: RoadMap, eyes: Eyes) -> None:
        self._road = road
        self._eyes = eyes
        self._internal_paths: dict[int, tuple[LanePath, tuple[int, ...]]] = {}

    def way_from_standstill(self, name: str, lane: str, present: bool, waved: Set[str]) -> WayOut:
        """The way of the AV `name`, which stands on the internal lane `lane`, out of the junction; its
        distance is 0 or inf.

        Args:
            present: count only road users in the way now, not those that drive or may soon wait there.
            waved: vehicles that the AV waves through: their whole way out of the junction is kept free.
        """
        own = self._road.index.get(lane, -1)
        others = [] if own < 0 else list(self._occupants(name, own, present, waved))
        if not others:
            return CLEAR
        get = self._eyes.view(name)
        standing = [bool(other) and get.getSpeed(other) < STANDING_SPEED for other, _ in others]
        mine = self.swept_path(name, own, get.getLanePosition(name))
        for side in self._lateral_offsets(name, own):
            way = _shifted(mine, get.getLateralLanePosition(name), side)
            touched = [
                (not stands and _will_touch(way + STANDING_MARGIN, theirs)) or _will_touch(way, theirs)
                for stands, (_, theirs) in zip(standing, others, strict=True)
            ]
            if not any(touched):
                return WayOut(math.inf, (), side)
            if any(one and not stands for one, stands in zip(touched, standing, strict=True)):
                break  # an AV does not swerve for moving road users
        in_the_way = zip(others, standing, touched, strict=True)
        return WayOut(0.0, tuple(other for (other, _), stands, hit in in_the_way if stands and hit))

    def way_ahead(
        self, name: str, lane: str, waved: Set[str], at: float | None = None, before: float = 0.0
    ) -> WayOut:
        """The way of the AV `name` over the internal lane `lane` and out of the junction, up to vehicles that
        stand in it, or slowly come to a waiting place in it. For an AV inside, persons block the way too.

        The way ends before a standing vehicle's own way out of the junction, so that this vehicle can go
        first. An AV that has already reached that way may go on. Vehicles beside the AV do not count.

        Args:
            waved: see `way_from_standstill`.
            at: m on `lane` where the way begins, `before` m ahead of the AV; None: at the AV.
        """
        own = self._road.index.get(lane, -1)
        get = self._eyes.view(name)
        obstacles = [] if own < 0 else list(self._obstacles(name, own, at is None, waved))
        if not obstacles:
            return CLEAR
        mine = self.swept_path(name, own, get.getLanePosition(name) if at is None else at)
        found = CLEAR
        for side in self._lateral_offsets(name, own):
            way = _shifted(mine, get.getLateralLanePosition(name), side, before)
            ahead = self._first_conflict(name, way, obstacles)
            if ahead.distance == math.inf:
                return ahead._replace(offset=side)
            found = ahead if found is CLEAR else found
            if "" in found.blockers:  # an AV does not swerve for persons
                break
        return found._replace(blockers=tuple(filter(None, found.blockers)))

    def can_pass(self, other: str, name: str) -> bool:
        """Whether a vehicle can leave the junction without touching the standing AV `name`."""
        way = self._way_out(other, name)
        return way is not None and not overlap(Boxes(*way), Boxes(*_body(name, sumo.vehicle))).any()

    def is_inside(self, name: str) -> bool:
        """Whether the front of a vehicle is inside a junction."""
        return self._internal_lane(name, sumo.vehicle) >= 0

    def queue_behind(self, name: str, lane: str) -> set[str]:
        """The vehicles behind the AV `name` on its way into the junction, before the line and after it."""
        own, get = self._road.index.get(lane, -1), sumo.vehicle
        if own < 0:
            return set()
        before = [own]
        while self._road.lanes[before[-1]].internal and (origins := self._road.before[before[-1]]):
            before.append(origins[0])
        at = get.getLanePosition(name)
        found = {other for k in before for other in sumo.lane.getLastStepVehicleIDs(self._road.lanes[k].id)}
        ahead = {o for o in sumo.lane.getLastStepVehicleIDs(lane) if get.getLanePosition(o) >= at}
        return found - ahead

    def swept_path(self, name: str, lane: int, at: float) -> Floats:
        """[5,k] x, y (m), heading (rad), length and width (m) of a vehicle every `SPACING` m: from `at` (m)
        on an internal lane until the vehicle has left the junction."""
        path, inside = self._internal_path(lane)
        ends, length = [*path.lane_start[1:], path.length], sumo.vehicle.getLength(name)
        k = inside.index(lane)
        scale = (ends[k] - path.lane_start[k]) / max(self._road.lanes[lane].length, SPACING)
        arc = np.arange(path.lane_start[k] + at * scale, ends[len(inside) - 1] + length, SPACING)
        front, rear = (np.stack(path.pose(a)[:2]) for a in (arc, arc - length))
        heading = np.arctan2(*(front - rear)[::-1])
        sizes = np.array([[length], [sumo.vehicle.getWidth(name)]])
        return np.concatenate([0.5 * (front + rear), [heading], sizes.repeat(len(arc), 1)])

    def persons(self, name: str, junction: str, seconds: float, kinds: str = "cw") -> Iterator[Floats]:
        """The places, over so many seconds, of each person that the AV `name` knows of on a junction's
        crossings and walking areas; `kinds`: "c" for crossings only."""
        get = sumo.person
        edges = [edge for edge in self._walk_edges[junction] if edge.rpartition("_")[2][0] in kinds]
        for person in (one for edge in edges for one in sumo.edge.getLastStepPersonIDs(edge)):
            place = self._eyes.person_position(name, person)
            if place is None:
                continue
            (x, y), heading = place, math.radians(90.0 - get.getAngle(person))
            way = np.arange(0.0, get.getSpeed(person) * seconds + 1e-9, SPACING)
            places = x + way * math.cos(heading), y + way * math.sin(heading), np.full(len(way), heading)
            yield np.stack([*places, *np.full((2, len(way)), PERSON_WIDTH)])

    # ---- inside ----

    def _way_out(self, other: str, name: str) -> Floats | None:
        """`swept_path` of a vehicle inside a junction, as `name` believes it; None for a vehicle outside."""
        get = self._eyes.view(name)
        lane = self._internal_lane(other, get)
        return None if lane < 0 else self.swept_path(other, lane, get.getLanePosition(other))

    def _known_on(self, name: str, lane: int) -> Iterable[str]:
        """The vehicles on a lane that the AV `name` knows of."""
        return self._eyes.known(name, sumo.lane.getLastStepVehicleIDs(self._road.lanes[lane].id))

    def _internal_lane(self, name: str, get: Any) -> int:
        try:
            lane = self._road.index.get(get.getLaneID(name), -1)
        except sumo.TraCIException:  # the vehicle has left the road
            return -1
        return lane if lane >= 0 and self._road.lanes[lane].internal else -1

    def _first_conflict(self, name: str, mine: Floats, obstacles: Sequence[tuple[str, Floats]]) -> WayOut:
        """The way `mine` of the AV `name` up to the first of the obstacles; a person is named ""."""
        distance = math.inf
        names: list[str] = []
        for other, theirs in obstacles:
            away = _first_touch(mine, theirs)
            if away == math.inf:
                continue
            if not other:
                names.append(other)
            elif self._eyes.view(name).getSpeed(other) < STANDING_SPEED:
                names.append(other)
                way = self._way_out(other, name)
                away = away if way is None else min(away, _first_touch(mine, way))
            distance = min(distance, away)
        return WayOut(distance, tuple(names))

    def _lateral_offsets(self, name: str, own: int) -> Iterator[float]:
        """m to the left of the lane's centre line at which the AV `name` fits into its lanes from the lane
        `own` out of the junction; the smallest first."""
        width = min(self._road.lanes[k].width for k in self._internal_path(own)[1])
        yield 0.0
        for k in range(1, int(0.5 * (width - sumo.vehicle.getWidth(name)) / OFFSET_STEP) + 1):
            yield k * OFFSET_STEP
            yield -k * OFFSET_STEP

    def _obstacles(self, name: str, own: int, inside: bool, waved: Set[str]) -> Iterator[tuple[str, Floats]]:
        """The vehicles that stand, or slowly come to a waiting place, in the junction of the lane `own`, and
        those whose rear still stands in it; `inside`: also persons on its crossings (named "").

        Vehicles on the AV's own path are left to SUMO's driver."""
        lanes, get = self._road.lanes, self._eyes.view(name)
        for lane in self._internal_lanes[lanes[own].start]:
            if lane in self._internal_path(own)[1]:
                continue
            for other in self._known_on(name, lane):
                speed = get.getSpeed(other)
                if other in waved:
                    yield other, self.swept_path(other, lane, get.getLanePosition(other))
                elif speed < STANDING_SPEED:
                    yield other, _body(other, get)
                elif speed < SLOW_SPEED and self._road.waits_inside(lane):
                    yield other, self.swept_path(other, lane, lanes[lane].length - WAITING_MARGIN)[:, :1]
        for other in self._tails(name, own):
            if get.getSpeed(other) < STANDING_SPEED:
                yield other, _body(other, get)
        if inside:
            for person in self.persons(name, lanes[own].start, ENTRY_HORIZON[0], "c"):
                yield "", person

    def _tails(self, name: str, own: int) -> Iterator[str]:
        """The vehicles that have left the junction except for their rear."""
        lanes, get = self._road.lanes, self._eyes.view(name)
        mine = {k for lane in self._internal_path(own)[1] for k in lanes[lane].successors}
        for lane in self._exit_lanes[lanes[own].start] - mine:
            for other in self._known_on(name, lane):
                if get.getLanePosition(other) < get.getLength(other):
                    yield other

    def _occupants(self, name: str, own: int, present: bool, waved: Set[str]) -> Iterator[tuple[str, Floats]]:
        """The road users that the AV `name` knows of on other ways through the junction of the lane `own`,
        now or soon: places (see `swept_path`) where they stand, will wait, drive or walk; persons are named
        "". `present`: only where they are now."""
        get, lanes, (_, way) = self._eyes.view(name), self._road.lanes, self._internal_path(own)
        seconds, metres = ENTRY_HORIZON
        for person in self.persons(name, lanes[own].start, 0.0 if present else seconds):
            yield "", person
        for other in self._tails(name, own):
            yield other, _body(other, get)
        for lane in self._internal_lanes[lanes[own].start]:
            if lane in way:  # left to SUMO's driver
                continue
            waits, end = self._road.waits_inside(lane), lanes[lane].length
            for other in self._known_on(name, lane):
                at, speed = get.getLanePosition(other), get.getSpeed(other)
                path = self.swept_path(other, lane, at)
                if other in waved:
                    yield other, path
                    continue
                if (present and not waits) or speed < STANDING_SPEED:
                    yield other, path[:, :1]
                    continue
                stands = min(at + speed**2 / (2.0 * STOPPING_DECEL), end) - at
                last = end - WAITING_MARGIN - at if waits else stands if speed < SLOW_SPEED else math.inf
                yield other, path[:, : int(min(max(last, 0.0) / SPACING, path.shape[1])) + 1]
            for origin in self._incoming_lanes[lane] if waits else ():
                for other in self._known_on(name, origin):
                    away, speed = lanes[origin].length - get.getLanePosition(other), get.getSpeed(other)
                    if away > max(seconds * speed, metres) or (present and speed < STANDING_SPEED):
                        continue
                    links = get.getNextLinks(other)
                    if links and links[0][4] == lanes[lane].id and links[0][5] not in RED + YELLOW:
                        yield other, self.swept_path(other, lane, end - WAITING_MARGIN)[:, :1]

    def _internal_path(self, lane: int) -> tuple[LanePath, tuple[int, ...]]:
        """The path over an internal lane, from the line on, and its lanes up to the junction's end."""
        if lane not in self._internal_paths:
            lanes, first = self._road.lanes, lane
            while before := [k for k in self._road.before[first] if lanes[k].internal]:
                first = before[0]
            if lane not in self._road.path(first).lanes:  # `lane` branches off that path
                first = lane
            path = self._road.path(first)
            self._internal_paths[lane] = path, tuple(takewhile(lambda k: lanes[k].internal, path.lanes))
        return self._internal_paths[lane]

    @cached_property
    def _internal_lanes(self) -> dict[str, list[int]]:
        """Junction -> its internal lanes."""
        found: defaultdict[str, list[int]] = defaultdict(list)
        for k, lane in enumerate(self._road.lanes):
            if lane.internal:
                found[lane.start].append(k)
        return found

    @cached_property
    def _exit_lanes(self) -> dict[str, set[int]]:
        """Junction -> the lanes that lead out of it."""
        lanes = self._road.lanes
        return {
            junction: {k for lane in inside for k in lanes[lane].successors if not lanes[k].internal}
            for junction, inside in self._internal_lanes.items()
        }

    @cached_property
    def _walk_edges(self) -> dict[str, list[str]]:
        """Junction -> its crossings (`:j_c0`) and walking areas (`:j_w0`)."""
        found: defaultdict[str, list[str]] = defaultdict(list)
        for edge in sumo.edge.getIDList():
            junction, _, kind = edge.rpartition("_")
            if junction.startswith(":") and kind[:1] in ("c", "w") and kind[1:].isdigit():
                found[junction[1:]].append(edge)
        return found

    @cached_property
    def _incoming_lanes(self) -> dict[int, list[int]]:
        """Internal lane -> the lanes that lead onto it over a stop line."""
        found: defaultdict[int, list[int]] = defaultdict(list)
        for link in self._road.links:
            found[link.via].append(link.origin)
        return found


def _shifted(way: Floats, now: float, side: float, before: float = 0.0) -> Floats:
    """The path `way` of a vehicle that moves from `now` to `side` m to the left of the lane's centre line,
    and starts `before` m ahead of the path."""
    driven = SWERVE_RATE * (before + SPACING * np.arange(way.shape[1]))
    left = now + np.clip(side - now, -driven, driven)
    return np.concatenate([[way[0] - left * np.sin(way[2]), way[1] + left * np.cos(way[2])], way[2:]])


def _first_touch(mine: Floats, theirs: Floats) -> float:
    """m on the path `mine` until it touches `theirs`; inf if it never does, or does so already: braking does
    not help beside another vehicle."""
    touched = overlap(Boxes(*mine[:, :, None]), Boxes(*theirs[:, None, :]))  # [places, places]
    places = np.flatnonzero(touched[:, ~touched[0]].any(1))
    return float(places[0]) * SPACING if len(places) else math.inf


def _will_touch(mine: Floats, theirs: Floats) -> bool:
    """Whether the path `mine` touches `theirs` later but not yet: waiting does not help beside a vehicle."""
    touched = overlap(Boxes(*mine[:, :, None]), Boxes(*theirs))  # [places, places]
    return bool(touched.any()) and not touched[0].any()


def _body(name: str, get: Any) -> Floats:
    """[5,1] x, y (m), heading (rad), length and width (m) of a vehicle now; `get`: of `Eyes.view`."""
    length = get.getLength(name)
    front = np.array([[*get.getPosition(name), get.getAngle(name), 0.5 * length]]).T
    return np.stack([*centres(*front), [length], [get.getWidth(name)]])
