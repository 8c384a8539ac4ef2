"""Who is in the way of an AV inside a junction, or before one.

There SUMO's driver heeds those who have the right of way. It starts into others who are passing, or who stand
partly across its way where the net lets them wait inside the junction
(https://sumo.dlr.de/docs/Simulation/Intersections.html, "Waiting within the intersection"). Here everybody is
looked at who is inside the junction with a part of his body, or soon will be, and persons who walk there.
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

STOPS = 4.5  # m/s2, with which who is slow comes to a stand
SLOW = 3.0  # m/s: who is faster passes
STOPS_BEFORE = 0.1  # m before the end of a lane, where SUMO's drivers wait inside a junction
SPACING = 0.25  # m between the places that are looked at
BESIDE = np.array([[0.0], [0.0], [0.0], [0.0], [0.2]])  # m of width more, for who stands
CREEPS = 0.5  # m/s: who is slower stands, for those who drive
PERSON = 0.5  # m, across
SIDE = 0.1  # m between the places beside its lane's centre at which an AV may pass
SWERVES = 0.2  # m to the side on each m driven
SOON = 3.0, 10.0  # s, or m, from a green line: who is so near will be inside


class Ahead(NamedTuple):
    """An AV's way out of a junction."""

    room: float  # m that it can drive; inf: all of it
    standing: tuple[str, ...] = ()  # the vehicles that stand in its way
    side: float = 0.0  # m to the left of its lane's centre, where it passes those who stand


CLEAR = Ahead(math.inf)


class Inside:
    """The insides of the junctions of `road`, as the AVs see them with their `eyes`."""

    def __init__(self, road: RoadMap, eyes: Eyes) -> None:
        self._road = road
        self._eyes = eyes
        self._ways: dict[int, tuple[LanePath, tuple[int, ...]]] = {}

    def blocked(self, name: str, lane: str, present: bool, waved: Set[str]) -> Ahead:
        """What keeps the AV `name`, which stands on the internal lane `lane`, from driving out of the
        junction; the room is 0 or inf.

        Args:
            present: count only those who are in its way now, not those who drive or may soon wait there.
            waved: vehicles that the AV lets pass: their whole way out of the junction is theirs.
        """
        own = self._road.index.get(lane, -1)
        others = [] if own < 0 else list(self._others(name, own, present, waved))
        if not others:
            return CLEAR
        get = self._eyes.of(name)
        still = [bool(other) and get.getSpeed(other) < CREEPS for other, _ in others]
        mine = self.through(name, own, get.getLanePosition(name))
        for side in self._sides(name, own):
            way = _aside(mine, get.getLateralLanePosition(name), side)
            touched = [
                (not stands and _comes_to(way + BESIDE, theirs)) or _comes_to(way, theirs)
                for stands, (_, theirs) in zip(still, others, strict=True)
            ]
            if not any(touched):
                return Ahead(math.inf, (), side)
            if any(one and not stands for one, stands in zip(touched, still, strict=True)):
                break  # nobody dodges those who drive or walk
        in_the_way = zip(others, still, touched, strict=True)
        return Ahead(0.0, tuple(other for (other, _), stands, hit in in_the_way if stands and hit))

    def room(
        self, name: str, lane: str, waved: Set[str], at: float | None = None, before: float = 0.0
    ) -> Ahead:
        """What keeps the AV `name` from driving over the internal lane `lane` and out of the junction:
        vehicles that stand in it, or slowly come to where they wait in it, and, if the AV is inside itself,
        persons who walk there; not those beside it.

        Of those who stand in its way the room ends where their way out of the junction begins, as far as the
        AV has not come to it yet, so that they can go first.

        Args:
            waved: see `blocked`.
            at: m on that lane from which it drives, where it is not there yet, but `before` m before it.
        """
        own = self._road.index.get(lane, -1)
        get = self._eyes.of(name)
        standing = [] if own < 0 else list(self._standing(name, own, at is None, waved))
        if not standing:
            return CLEAR
        mine = self.through(name, own, get.getLanePosition(name) if at is None else at)
        found = CLEAR
        for side in self._sides(name, own):
            way = _aside(mine, get.getLateralLanePosition(name), side, before)
            ahead = self._until(name, way, standing)
            if ahead.room == math.inf:
                return ahead._replace(side=side)
            found = ahead if found is CLEAR else found
            if "" in found.standing:  # nobody dodges those who walk
                break
        return found._replace(standing=tuple(filter(None, found.standing)))

    def can_pass(self, other: str, name: str) -> bool:
        """Whether a vehicle gets out of the junction without touching the AV `name`, which stands."""
        way = self._way_out(other, name)
        return way is not None and not overlap(Boxes(*way), Boxes(*_body(name, sumo.vehicle))).any()

    def inside(self, name: str) -> bool:
        """Whether the front of a vehicle is inside a junction."""
        return self._lane_inside(name, sumo.vehicle) >= 0

    def behind(self, name: str, lane: str) -> set[str]:
        """The vehicles behind the AV `name` on its way into the junction: on its lane before the line, and
        after it up to the AV."""
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

    def walkers(self, name: str, junction: str, seconds: float, kinds: str = "cw") -> Iterator[Floats]:
        """The places of each person that the AV `name` knows of on the crossings and walking areas of a
        junction, for so many seconds; `kinds`: c for those on crossings alone."""
        get = sumo.person
        edges = [edge for edge in self._walks[junction] if edge.rpartition("_")[2][0] in kinds]
        for who in (one for edge in edges for one in sumo.edge.getLastStepPersonIDs(edge)):
            place = self._eyes.place(name, who)
            if place is None:
                continue
            (x, y), heading = place, math.radians(90.0 - get.getAngle(who))
            way = np.arange(0.0, get.getSpeed(who) * seconds + 1e-9, SPACING)
            places = x + way * math.cos(heading), y + way * math.sin(heading), np.full(len(way), heading)
            yield np.stack([*places, *np.full((2, len(way)), PERSON)])

    # ---- inside ----

    def _way_out(self, other: str, name: str) -> Floats | None:
        """`through` of a vehicle inside a junction from where `name` sees it; None for one that is not
        inside."""
        get = self._eyes.of(name)
        lane = self._lane_inside(other, get)
        return None if lane < 0 else self.through(other, lane, get.getLanePosition(other))

    def _on(self, name: str, lane: int) -> Iterable[str]:
        """The vehicles on a lane that the AV `name` knows of."""
        return self._eyes.known(name, sumo.lane.getLastStepVehicleIDs(self._road.lanes[lane].id))

    def _lane_inside(self, name: str, get: Any) -> int:
        try:
            lane = self._road.index.get(get.getLaneID(name), -1)
        except sumo.TraCIException:  # it has left the road
            return -1
        return lane if lane >= 0 and self._road.lanes[lane].internal else -1

    def _until(self, name: str, mine: Floats, standing: Sequence[tuple[str, Floats]]) -> Ahead:
        """The way `mine` of the AV `name` until it touches somebody of `standing`; "" in it stands for those
        who walk."""
        room = math.inf
        names: list[str] = []
        for other, theirs in standing:
            away = _first_touch(mine, theirs)
            if away == math.inf:
                continue
            if not other:
                names.append(other)
            elif self._eyes.of(name).getSpeed(other) < CREEPS:
                names.append(other)
                way = self._way_out(other, name)
                away = away if way is None else min(away, _first_touch(mine, way))
            room = min(room, away)
        return Ahead(room, tuple(names))

    def _sides(self, name: str, own: int) -> Iterator[float]:
        """m to the left of its lane's centre at which the AV `name` can drive out of the junction from the
        lane `own`, within the lanes; the nearest to the centre first."""
        width = min(self._road.lanes[k].width for k in self._way(own)[1])
        yield 0.0
        for k in range(1, int(0.5 * (width - sumo.vehicle.getWidth(name)) / SIDE) + 1):
            yield k * SIDE
            yield -k * SIDE

    def _standing(self, name: str, own: int, inside: bool, waved: Set[str]) -> Iterator[tuple[str, Floats]]:
        """Who stands, as the AV `name` sees it, in the junction of the lane `own`, with his tail at least, or
        slowly comes to a place where the net lets him wait in it; not on the way over that lane, where SUMO's
        driver heeds them.
        `inside`: who walks over its crossings too (without a name)."""
        lanes, get = self._road.lanes, self._eyes.of(name)
        for lane in self._lanes[lanes[own].start]:
            if lane in self._way(own)[1]:
                continue
            for other in self._on(name, lane):
                speed = get.getSpeed(other)
                if other in waved:
                    yield other, self.through(other, lane, get.getLanePosition(other))
                elif speed < CREEPS:
                    yield other, _body(other, get)
                elif speed < SLOW and self._road.waits_inside(lane):
                    yield other, self.through(other, lane, lanes[lane].length - STOPS_BEFORE)[:, :1]
        for other in self._tails(name, own):
            if get.getSpeed(other) < CREEPS:
                yield other, _body(other, get)
        if inside:
            for walker in self.walkers(name, lanes[own].start, SOON[0], "c"):
                yield "", walker

    def _tails(self, name: str, own: int) -> Iterator[str]:
        """Who has left that junction but for his tail."""
        lanes, get = self._road.lanes, self._eyes.of(name)
        mine = {k for lane in self._way(own)[1] for k in lanes[lane].successors}
        for lane in self._beyond[lanes[own].start] - mine:
            for other in self._on(name, lane):
                if get.getLanePosition(other) < get.getLength(other):
                    yield other

    def _others(self, name: str, own: int, present: bool, waved: Set[str]) -> Iterator[tuple[str, Floats]]:
        """The places, as `through`'s, of those that the AV `name` knows of who are on other ways through the
        junction of the lane `own`, or soon will be: where they stand, will wait, drive or walk (persons
        without a name); `present`: where they are."""
        get, lanes, (_, way) = self._eyes.of(name), self._road.lanes, self._way(own)
        seconds, metres = SOON
        for walker in self.walkers(name, lanes[own].start, 0.0 if present else seconds):
            yield "", walker
        for other in self._tails(name, own):
            yield other, _body(other, get)
        for lane in self._lanes[lanes[own].start]:
            if lane in way:  # SUMO's driver heeds them
                continue
            waits, end = self._road.waits_inside(lane), lanes[lane].length
            for other in self._on(name, lane):
                at, speed = get.getLanePosition(other), get.getSpeed(other)
                through = self.through(other, lane, at)
                if other in waved:
                    yield other, through
                    continue
                if (present and not waits) or speed < CREEPS:
                    yield other, through[:, :1]
                    continue
                stands = min(at + speed**2 / (2.0 * STOPS), end) - at
                last = end - STOPS_BEFORE - at if waits else stands if speed < SLOW else math.inf
                yield other, through[:, : int(min(max(last, 0.0) / SPACING, through.shape[1])) + 1]
            for origin in self._origins[lane] if waits else ():
                for other in self._on(name, origin):
                    away, speed = lanes[origin].length - get.getLanePosition(other), get.getSpeed(other)
                    if away > max(seconds * speed, metres) or (present and speed < CREEPS):
                        continue
                    links = get.getNextLinks(other)
                    if links and links[0][4] == lanes[lane].id and links[0][5] not in RED + YELLOW:
                        yield other, self.through(other, lane, end - STOPS_BEFORE)[:, :1]

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


def _aside(way: Floats, now: float, side: float, before: float = 0.0) -> Floats:
    """The way of one that is `now` m to the left of its lane's centre, `before` m before the way begins, and
    moves to `side` m."""
    driven = SWERVES * (before + SPACING * np.arange(way.shape[1]))
    left = now + np.clip(side - now, -driven, driven)
    return np.concatenate([[way[0] - left * np.sin(way[2]), way[1] + left * np.cos(way[2])], way[2:]])


def _first_touch(mine: Floats, theirs: Floats) -> float:
    """m on the way `mine` until it touches `theirs`; inf where it never does, or does now: to stay is no
    help against who is beside it."""
    touched = overlap(Boxes(*mine[:, :, None]), Boxes(*theirs[:, None, :]))  # [places, places]
    places = np.flatnonzero(touched[:, ~touched[0]].any(1))
    return float(places[0]) * SPACING if len(places) else math.inf


def _comes_to(mine: Floats, theirs: Floats) -> bool:
    """Whether one that drives `mine` touches `theirs` on its way and is not beside it: to stay is no help."""
    touched = overlap(Boxes(*mine[:, :, None]), Boxes(*theirs))  # [places, places]
    return bool(touched.any()) and not touched[0].any()


def _body(name: str, get: Any) -> Floats:
    """[5,1] x, y (m), heading (rad), length and width (m) of a vehicle where it is; `get`: of `Eyes.of`."""
    length = get.getLength(name)
    front = np.array([[*get.getPosition(name), get.getAngle(name), 0.5 * length]]).T
    return np.stack([*centres(*front), [length], [get.getWidth(name)]])
