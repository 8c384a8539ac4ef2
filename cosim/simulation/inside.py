"""Who stands in an AV's way inside a junction.

There SUMO's driver heeds those who have the right of way, and drives past, or into, those who stand partly
across its way: because the road behind is full, or where the net lets them wait inside the junction
(https://sumo.dlr.de/docs/Simulation/Intersections.html, "Waiting within the intersection").
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from itertools import takewhile

import numpy as np

from cosim.geometry import Boxes, overlap
from cosim.road import RoadMap
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.types import Floats

STOPS = 4.5  # m/s2, with which who is slow comes to a stand
SLOW = 3.0  # m/s: who is faster passes
SPACING = 0.25  # m between the places that are looked at
BESIDE = 0.1  # m that an AV wants to have free on either side
SOON = 3.0, 10.0  # s, or m, from a green line: who is so near will be inside


class Inside:
    """The insides of the junctions of `road`."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road

    def in_the_way(self, name: str, lane: str) -> str:
        """Who the AV `name`, which stands on the internal lane `lane`, would touch on its way out of the
        junction: somebody who stands there or drives through, or may soon wait there; "" for nobody."""
        get, own = sumo.vehicle, self._road.index.get(lane, -1)
        if own < 0:
            return ""
        mine = None
        for other, theirs in self._others(own):
            if mine is None:
                mine = self._through(name, own, get.getLanePosition(name), BESIDE)
            touched = overlap(Boxes(*mine[:, :, None]), Boxes(*theirs))  # [places, places]
            if touched.any() and not touched[0].any():  # else it is beside: to stay would not help
                return other
        return ""

    # ---- inside ----

    def _others(self, own: int) -> Iterator[tuple[str, Floats]]:
        """Names, and places as `_through`'s, of those who are on other ways through the junction of the lane
        `own`, or soon will be: where they stand, will wait, or drive through."""
        get, lanes, way = sumo.vehicle, self._road.lanes, self._way(own)
        for lane in self._lanes[lanes[own].start]:
            if lane in way:  # SUMO's driver heeds them
                continue
            waits, end = self._road.waits_inside(lane), lanes[lane].length
            for other in sumo.lane.getLastStepVehicleIDs(lanes[lane].id):
                at, speed = get.getLanePosition(other), get.getSpeed(other)
                through = self._through(other, lane, at)
                stands = min(at + speed**2 / (2.0 * STOPS), end) - at
                last = end - at if waits else stands if speed < SLOW else math.inf
                yield other, through[:, : int(min(last / SPACING, through.shape[1])) + 1]
            for origin in self._origins[lane] if waits else ():
                for other in sumo.lane.getLastStepVehicleIDs(lanes[origin].id):
                    seconds, metres = SOON
                    away = lanes[origin].length - get.getLanePosition(other)
                    if away > max(seconds * get.getSpeed(other), metres):
                        continue
                    links = get.getNextLinks(other)
                    if links and links[0][4] == lanes[lane].id and links[0][5] not in RED + YELLOW:
                        yield other, self._through(other, lane, end)[:, :1]

    def _through(self, name: str, lane: int, at: float, beside: float = 0.0) -> Floats:
        """[5,k] x, y (m), heading (rad), length and width (m) of a vehicle every `SPACING` m on its way from
        `at` (m) on a lane inside a junction until it has left it; `beside`: m more on either side."""
        road, length = self._road, sumo.vehicle.getLength(name)
        path = road.path(lane)
        leaves = takewhile(lambda k: road.lanes[k].internal, path.lanes)
        left = sum(road.lanes[k].length for k in leaves) - at + length
        along = at + np.arange(0.0, left, SPACING)
        front = np.stack(path.pose(along * path.scale)[:2])
        rear = np.stack(path.pose((along - length) * path.scale)[:2])
        heading = np.arctan2(*(front - rear)[::-1])
        sizes = np.array([[length], [sumo.vehicle.getWidth(name) + 2.0 * beside]])
        return np.concatenate([0.5 * (front + rear), [heading], sizes.repeat(len(along), 1)])

    def _way(self, lane: int) -> set[int]:
        """A lane inside a junction, with those in it that lead there, and that it leads to."""
        lanes, before = self._road.lanes, self._road.before
        found, ends = {lane}, [lane]
        while ends:
            near = ends.pop()
            new = {k for k in (*lanes[near].successors, *before[near]) if lanes[k].internal} - found
            found |= new
            ends += new
        return found

    @cached_property
    def _lanes(self) -> dict[str, list[int]]:
        """Junction -> the lanes inside it."""
        found: defaultdict[str, list[int]] = defaultdict(list)
        for k, lane in enumerate(self._road.lanes):
            if lane.internal:
                found[lane.start].append(k)
        return found

    @cached_property
    def _origins(self) -> dict[int, list[int]]:
        """Lane inside a junction -> the lanes that lead onto it over a stop line."""
        found: defaultdict[int, list[int]] = defaultdict(list)
        for link in self._road.links:
            found[link.via].append(link.origin)
        return found
