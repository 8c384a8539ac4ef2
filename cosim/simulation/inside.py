"""Who stands in an AV's way inside a junction.

There SUMO's driver heeds those who have the right of way, and drives past, or into, those who stand partly
across its way: because the road behind is full, or where the net lets them wait inside the junction
(https://sumo.dlr.de/docs/Simulation/Intersections.html, "Waiting within the intersection").
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from cosim.geometry import Boxes, overlap
from cosim.road import RoadMap
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.conventions import centres

STOPS = 4.5  # m/s2, with which who is slow comes to a stand
SLOW = 3.0  # m/s: who is faster passes
SPACING = 0.25  # m between the places that are looked at
BESIDE = 0.1  # m that an AV wants to have free on either side
SOON = 3.0, 10.0  # s, or m, from a green line: who is so near will be inside

Box = tuple[float, float, float, float, float]  # centre (m), heading (rad), length and width (m)


class Inside:
    """The insides of the junctions of `road`."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road

    def in_the_way(self, name: str, lane: str) -> str:
        """Who the AV `name`, which stands on the internal lane `lane`, would touch on its way out of the
        junction, if everybody else who is slow came to a stand and who may wait there did; "" for nobody."""
        get, road = sumo.vehicle, self._road
        own = road.index.get(lane, -1)
        came, leaves = self._way(own) if own >= 0 else ([], [])
        others = list(self._others({*came, *leaves}))
        if not others:
            return ""
        length, at = get.getLength(name), get.getLanePosition(name)
        path = road.path(own)
        left = sum(road.lanes[k].length for k in leaves) - at
        ahead = np.arange(0.0, left + length, SPACING)
        front = np.stack(path.pose((at + ahead) * path.scale)[:2])
        rear = np.stack(path.pose((at + ahead - length) * path.scale)[:2])
        heading = np.arctan2(*(front - rear)[::-1])
        x, y = 0.5 * (front + rear)[..., None]
        places = Boxes(x, y, heading[:, None], length, get.getWidth(name) + 2.0 * BESIDE)
        touched = overlap(places, Boxes(*np.array([box for _, box in others]).T))  # [places, others]
        touched[:, touched[0]] = False  # who is touched where it is now is beside it: to stand would not help
        first = touched[touched.any(axis=1).argmax()]
        return others[int(first.argmax())][0] if first.any() else ""

    # ---- inside ----

    def _others(self, way: set[int]) -> Iterator[tuple[str, Box]]:
        """Names and boxes of those who stand in the junction of `way`, not on it: where they will."""
        get, lanes = sumo.vehicle, self._road.lanes
        junction = next((lanes[lane].start for lane in way), "")
        for lane in self._lanes.get(junction, ()):
            if lane in way:  # SUMO's driver heeds them
                continue
            waits = self._road.waits_inside(lane)
            for other in sumo.lane.getLastStepVehicleIDs(lanes[lane].id):
                speed = get.getSpeed(other)
                if waits:
                    yield other, self._at_end(other, lane)
                elif speed < SLOW:
                    x, y = get.getPosition(other)
                    yield other, _at(other, x, y, get.getAngle(other), speed**2 / (2.0 * STOPS))
            for origin in self._origins[lane] if waits else ():
                for other in sumo.lane.getLastStepVehicleIDs(lanes[origin].id):
                    seconds, metres = SOON
                    away = lanes[origin].length - get.getLanePosition(other)
                    if away > max(seconds * get.getSpeed(other), metres):
                        continue
                    links = get.getNextLinks(other)
                    if links and links[0][4] == lanes[lane].id and links[0][5] not in RED + YELLOW:
                        yield other, self._at_end(other, lane)

    def _at_end(self, name: str, lane: int) -> Box:
        """Where it waits at the end of a lane inside the junction."""
        path = self._road.path(lane)
        x, y, heading = path.pose(np.array([self._road.lanes[lane].length * path.scale]))
        return _at(name, float(x[0]), float(y[0]), 90.0 - math.degrees(float(heading[0])))

    def _way(self, lane: int) -> tuple[list[int], list[int]]:
        """A lane inside a junction and those before it, back to the line, and it and those after it."""
        lanes, before = self._road.lanes, self._road.before
        came, leaves = [lane], [lane]
        while following := [k for k in lanes[leaves[-1]].successors if lanes[k].internal]:
            leaves.append(following[0])
        while earlier := [k for k in before[came[-1]] if lanes[k].internal]:
            came.append(earlier[0])
        return came, leaves

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


def _at(name: str, x: float, y: float, angle: float, further: float = 0.0) -> Box:
    """A vehicle with its front at x and y (m), by SUMO's angle (degrees), `further` m on."""
    length = sumo.vehicle.getLength(name)
    half = np.array([0.5 * length - further])
    cx, cy, heading = centres(np.array([x]), np.array([y]), np.array([angle]), half)
    return float(cx[0]), float(cy[0]), float(heading[0]), length, sumo.vehicle.getWidth(name)
