"""Who is in the way of an AV inside a junction, or before one.

There SUMO's driver heeds those who have the right of way. It starts into others who are passing, or who stand
partly across its way where the net lets them wait inside the junction
(https://sumo.dlr.de/docs/Simulation/Intersections.html, "Waiting within the intersection"). Here everybody is
looked at who is inside the junction with a part of his body, or soon will be, and persons who walk there.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from itertools import takewhile

import numpy as np

from cosim.geometry import Boxes, overlap
from cosim.road import LanePath, RoadMap
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.conventions import centres
from cosim.types import Floats

STOPS = 4.5  # m/s2, with which who is slow comes to a stand
SLOW = 3.0  # m/s: who is faster passes
SPACING = 0.25  # m between the places that are looked at
BESIDE = np.array([[0.0], [0.0], [0.0], [0.0], [0.2]])  # m of width more, for who stands
CREEPS = 0.5  # m/s: who is slower stands, for those who drive
PERSON = 0.5  # m, across
SOON = 3.0, 10.0  # s, or m, from a green line: who is so near will be inside


class Inside:
    """The insides of the junctions of `road`."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self._ways: dict[int, tuple[LanePath, tuple[int, ...]]] = {}

    def blocked(self, name: str, lane: str, present: bool = False) -> bool:
        """Whether the AV `name`, which stands on the internal lane `lane`, would touch somebody on its way
        out of the junction: who stands there, drives or walks through, or may soon wait there; `present`: who
        is there."""
        own = self._road.index.get(lane, -1)
        if own < 0:
            return False
        mine = None
        for theirs in self._others(own, present):
            if mine is None:
                mine = self.through(name, own, sumo.vehicle.getLanePosition(name))
            if _comes_to(mine + BESIDE, theirs) or _comes_to(mine, theirs):
                return True
        return False

    def room(self, name: str, lane: str, at: float | None = None) -> float:
        """m that the AV `name` can drive over the internal lane `lane`, from where it is or from `at` (m),
        until it touches somebody who stands in the junction, or slowly comes to where he waits in it, or, if
        it is inside itself, walks there; inf where nobody does but who is beside it."""
        own = self._road.index.get(lane, -1)
        get = sumo.vehicle
        standing = [] if own < 0 else list(self._standing(own, inside=at is None))
        if not standing:
            return math.inf
        mine = self.through(name, own, get.getLanePosition(name) if at is None else at)
        theirs = Boxes(*np.concatenate(standing, 1)[:, None, :])
        touched = overlap(Boxes(*mine[:, :, None]), theirs)  # [places, who]
        places = np.flatnonzero(touched[:, ~touched[0]].any(1))
        return float(places[0]) * SPACING if len(places) else math.inf

    def through(self, name: str, lane: int, at: float) -> Floats:
        """[5,k] x, y (m), heading (rad), length and width (m) of a vehicle every `SPACING` m on its way from
        `at` (m) on a lane inside a junction until it has left it."""
        path, inside = self._way(lane)
        ends, length = [*path.lane_start[1:], path.length], sumo.vehicle.getLength(name)
        k = inside.index(lane)
        scale = (ends[k] - path.lane_start[k]) / max(self._road.lanes[lane].length, SPACING)
        arc = np.arange(path.lane_start[k] + at * scale, ends[len(inside) - 1] + length, SPACING)
        front, rear = (np.stack(path.pose(a)[:2]) for a in (arc, arc - length))
        heading = np.arctan2(*(front - rear)[::-1])
        sizes = np.array([[length], [sumo.vehicle.getWidth(name)]])
        return np.concatenate([0.5 * (front + rear), [heading], sizes.repeat(len(arc), 1)])

    def walkers(self, junction: str, seconds: float, kinds: str = "cw") -> Iterator[Floats]:
        """The places of each person on the crossings and walking areas of a junction, for so many seconds;
        `kinds`: c for those on crossings alone."""
        get = sumo.person
        edges = [edge for edge in self._walks[junction] if edge.rpartition("_")[2][0] in kinds]
        for who in (one for edge in edges for one in sumo.edge.getLastStepPersonIDs(edge)):
            (x, y), heading = get.getPosition(who), math.radians(90.0 - get.getAngle(who))
            way = np.arange(0.0, get.getSpeed(who) * seconds + 1e-9, SPACING)
            places = x + way * math.cos(heading), y + way * math.sin(heading), np.full(len(way), heading)
            yield np.stack([*places, *np.full((2, len(way)), PERSON)])

    # ---- inside ----

    def _standing(self, own: int, inside: bool) -> Iterator[Floats]:
        """Who stands in the junction of the lane `own`, with his tail at least, or slowly comes to a place
        where the net lets him wait in it; not on the way over that lane, where SUMO's driver heeds them.
        `inside`: who walks over its crossings too."""
        lanes, get = self._road.lanes, sumo.vehicle
        for lane in self._lanes[lanes[own].start]:
            if lane in self._way(own)[1]:
                continue
            for other in sumo.lane.getLastStepVehicleIDs(lanes[lane].id):
                speed = get.getSpeed(other)
                if speed < CREEPS:
                    yield _body(other)
                if speed < SLOW and self._road.waits_inside(lane):
                    yield self.through(other, lane, lanes[lane].length)[:, :1]
        for other in self._tails(own):
            if get.getSpeed(other) < CREEPS:
                yield _body(other)
        if inside:
            yield from self.walkers(lanes[own].start, SOON[0], "c")

    def _tails(self, own: int) -> Iterator[str]:
        """Who has left that junction but for his tail."""
        lanes, get = self._road.lanes, sumo.vehicle
        mine = {k for lane in self._way(own)[1] for k in lanes[lane].successors}
        for lane in self._beyond[lanes[own].start] - mine:
            for other in sumo.lane.getLastStepVehicleIDs(lanes[lane].id):
                if get.getLanePosition(other) < get.getLength(other):
                    yield other

    def _others(self, own: int, present: bool) -> Iterator[Floats]:
        """The places, as `through`'s, of those who are on other ways through the junction of the lane `own`,
        or soon will be: where they stand, will wait, drive or walk; `present`: where they are."""
        get, lanes, (_, way) = sumo.vehicle, self._road.lanes, self._way(own)
        seconds, metres = SOON
        yield from self.walkers(lanes[own].start, 0.0 if present else seconds)
        yield from map(_body, self._tails(own))
        for lane in self._lanes[lanes[own].start]:
            if lane in way:  # SUMO's driver heeds them
                continue
            waits, end = self._road.waits_inside(lane), lanes[lane].length
            for other in sumo.lane.getLastStepVehicleIDs(lanes[lane].id):
                at, speed = get.getLanePosition(other), get.getSpeed(other)
                through = self.through(other, lane, at)
                if present:
                    yield through[:, :1]
                    continue
                stands = min(at + speed**2 / (2.0 * STOPS), end) - at
                last = end - at if waits else stands if speed < SLOW else math.inf
                yield through[:, : int(min(last / SPACING, through.shape[1])) + 1]
            for origin in self._origins[lane] if waits and not present else ():
                for other in sumo.lane.getLastStepVehicleIDs(lanes[origin].id):
                    away = lanes[origin].length - get.getLanePosition(other)
                    if away > max(seconds * get.getSpeed(other), metres):
                        continue
                    links = get.getNextLinks(other)
                    if links and links[0][4] == lanes[lane].id and links[0][5] not in RED + YELLOW:
                        yield self.through(other, lane, end)[:, :1]

    def _way(self, lane: int) -> tuple[LanePath, tuple[int, ...]]:
        """The path over a lane inside a junction from the line on, and its lanes up to the junction's end."""
        if lane not in self._ways:
            lanes, first = self._road.lanes, lane
            while before := [k for k in self._road.before[first] if lanes[k].internal]:
                first = before[0]
            if lane not in self._road.path(first).lanes:  # it parts from that path
                first = lane
            path = self._road.path(first)
            self._ways[lane] = path, tuple(takewhile(lambda k: lanes[k].internal, path.lanes))
        return self._ways[lane]

    @cached_property
    def _lanes(self) -> dict[str, list[int]]:
        """Junction -> the lanes inside it."""
        found: defaultdict[str, list[int]] = defaultdict(list)
        for k, lane in enumerate(self._road.lanes):
            if lane.internal:
                found[lane.start].append(k)
        return found

    @cached_property
    def _beyond(self) -> dict[str, set[int]]:
        """Junction -> the lanes that lead out of it."""
        lanes = self._road.lanes
        return {
            junction: {k for lane in inside for k in lanes[lane].successors if not lanes[k].internal}
            for junction, inside in self._lanes.items()
        }

    @cached_property
    def _walks(self) -> dict[str, list[str]]:
        """Junction -> its crossings (`:j_c0`) and walking areas (`:j_w0`)."""
        found: defaultdict[str, list[str]] = defaultdict(list)
        for edge in sumo.edge.getIDList():
            junction, _, kind = edge.rpartition("_")
            if junction.startswith(":") and kind[:1] in ("c", "w") and kind[1:].isdigit():
                found[junction[1:]].append(edge)
        return found

    @cached_property
    def _origins(self) -> dict[int, list[int]]:
        """Lane inside a junction -> the lanes that lead onto it over a stop line."""
        found: defaultdict[int, list[int]] = defaultdict(list)
        for link in self._road.links:
            found[link.via].append(link.origin)
        return found


def _comes_to(mine: Floats, theirs: Floats) -> bool:
    """Whether one that drives `mine` touches `theirs` on its way and is not beside it: to stay is no help."""
    touched = overlap(Boxes(*mine[:, :, None]), Boxes(*theirs))  # [places, places]
    return bool(touched.any()) and not touched[0].any()


def _body(name: str) -> Floats:
    """[5,1] x, y (m), heading (rad), length and width (m) of a vehicle where it is."""
    get = sumo.vehicle
    length = get.getLength(name)
    front = np.array([[*get.getPosition(name), get.getAngle(name), 0.5 * length]]).T
    return np.stack([*centres(*front), [length], [get.getWidth(name)]])
