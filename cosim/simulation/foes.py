"""Who has the right of way over a link (https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks, requests)."""

from collections.abc import Callable, Sequence
from functools import cache, cached_property, partial
from itertools import pairwise

from cosim.road import RoadMap
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes


class Foes:
    """The vehicles with the right of way over the links of `road`, at most `within` m before their line.

    `eyes`: with them, those that the vehicle which enters knows of.
    """

    def __init__(self, road: RoadMap, within: float, eyes: Eyes | None = None) -> None:
        self._road = road
        self._eyes = eyes
        self._within = within
        self._position_of = partial(sumo.getter, "vehicle")("LanePosition")

    def of(self, entered: int, name: str) -> tuple[tuple[str, int], ...]:
        """Vehicles with the right of way over the link `entered`, each with its own link: on its internal
        lanes, or on the way to it. `name`, which enters, is none of them."""
        first = [foe for foe in self._road.links[entered].foes if not self._red(foe)]
        if not first:
            return ()
        found: dict[str, int] = {}
        edges = {self._road.lanes[self._road.links[foe].origin].edge for foe in first}
        for foe in first:
            for inner in self._road.inside[foe]:
                lane_id = self._road.lanes[inner].id
                found.update((other, foe) for other in sumo.lane.getLastStepVehicleIDs(lane_id))
        for lane, position in self._before(entered):
            for other in sumo.lane.getLastStepVehicleIDs(self._road.lanes[lane].id):
                if other not in found and self._position_of(other) >= position:
                    taken = self._taken(other, lane, edges)
                    found.update((other, foe) for foe in first if foe in taken)
        found.pop(name, None)
        if self._eyes is not None:
            return tuple((other, found[other]) for other in self._eyes.known(name, found))
        return tuple(found.items())

    # ---- inside ----

    def _red(self, number: int) -> bool:
        link = self._road.links[number]
        if link.signal < 0:
            return False
        light, index = self._road.signals[link.signal]
        return sumo.trafficlight.getRedYellowGreenState(light)[index] in "ru"

    def _taken(self, name: str, lane: int, edges: set[str]) -> Sequence[int]:
        """The links that a vehicle on `lane` may take where its route next leaves one of `edges`.

        They go on from the lanes that it can be on without a change; all of them, where there are none.
        """
        route = sumo.vehicle.getRoute(name)
        place = sumo.vehicle.getRouteIndex(name)
        at = {lane}
        while self._road.lanes[lane].internal:  # the lane it comes out on
            at = set(self._road.lanes[lane].successors)
            lane = next(iter(at), lane)
        for here, then in pairwise(route[place + (self._road.lanes[lane].edge != route[place]) :]):
            options = self._between.get((here, then), ())
            taken = [k for k in options if self._road.links[k].origin in at] or options
            if here in edges:
                return taken
            at = {self._road.links[k].target for k in taken}
        return ()

    @cached_property
    def _before(self) -> Callable[[int], tuple[tuple[int, float], ...]]:
        """The lanes before the lines of a link's foes; on each the position (m) from which on one is within
        `within` of the line."""
        return cache(self._lanes_before)

    @cached_property
    def _between(self) -> dict[tuple[str, str], list[int]]:
        """(edge, edge) -> the links from one to the other."""
        found: dict[tuple[str, str], list[int]] = {}
        for k, link in enumerate(self._road.links):
            edges = self._road.lanes[link.origin].edge, self._road.lanes[link.target].edge
            found.setdefault(edges, []).append(k)
        return found

    def _lanes_before(self, number: int) -> tuple[tuple[int, float], ...]:
        lanes, links = self._road.lanes, self._road.links
        left: dict[str, float] = {}  # edge -> m of it, from its end, that are within reach
        waiting = [(lanes[links[foe].origin].edge, self._within) for foe in links[number].foes]
        while waiting:
            edge, reach = waiting.pop()
            if reach <= left.get(edge, 0.0):
                continue
            left[edge] = reach
            for lane in self._road.lanes_of[edge]:
                more = reach - lanes[lane].length
                waiting += [(lanes[origin].edge, more) for origin in self._road.before[lane]]
        inside = lanes[links[number].via].start if links[number].via >= 0 else ""
        return tuple(
            (lane, lanes[lane].length - reach)
            for edge, reach in left.items()
            for lane in self._road.lanes_of[edge]
            if not (lanes[lane].internal and lanes[lane].start == inside)
        )
