"""The vehicles with priority over a link (https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks, requests)."""

from collections.abc import Callable, Sequence
from functools import cache, cached_property, partial
from itertools import pairwise

from cosim.road import RoadMap
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes


class Foes:
    """The vehicles with priority over the links of `road`, at most `within` m before their line.

    `eyes`: restrict them to the vehicles that the entering AV knows of.
    """

    def __init__(self, road: RoadMap, within: float, eyes: Eyes | None = None) -> None:
        self._road = road
        self._eyes = eyes
        self._within = within
        self._position_of = partial(sumo.getter, "vehicle")("LanePosition")

    def find(self, link_index: int, name: str) -> tuple[tuple[str, int], ...]:
        """The vehicles with priority over the link `link_index`, on the way to their own link or inside the
        junction, each with that link; without the entering vehicle `name`."""
        foes = [foe for foe in self._road.links[link_index].foes if not self._is_red(foe)]
        if not foes:
            return ()
        found: dict[str, int] = {}
        edges = {self._road.lanes[self._road.links[foe].origin].edge for foe in foes}
        for foe in foes:
            for inner in self._road.inside[foe]:
                lane_id = self._road.lanes[inner].id
                found.update((other, foe) for other in sumo.lane.getLastStepVehicleIDs(lane_id))
        for lane, position in self._approaches(link_index):
            for other in sumo.lane.getLastStepVehicleIDs(self._road.lanes[lane].id):
                if other not in found and self._position_of(other) >= position:
                    options = self._possible_links(other, lane, edges)
                    found.update((other, foe) for foe in foes if foe in options)
        found.pop(name, None)
        if self._eyes is not None:
            return tuple((other, found[other]) for other in self._eyes.known(name, found))
        return tuple(found.items())

    # ---- inside ----

    def _is_red(self, link_index: int) -> bool:
        link = self._road.links[link_index]
        if link.signal < 0:
            return False
        light, index = self._road.signals[link.signal]
        return sumo.trafficlight.getRedYellowGreenState(light)[index] in "ru"

    def _possible_links(self, name: str, lane: int, edges: set[str]) -> Sequence[int]:
        """The links that a vehicle on `lane` may take where its route next leaves one of `edges`.

        These start from lanes that the vehicle reaches without a lane change, or from all if there are none.
        """
        route = sumo.vehicle.getRoute(name)
        index = sumo.vehicle.getRouteIndex(name)
        reachable = {lane}
        while self._road.lanes[lane].internal:  # the lane after the junction
            reachable = set(self._road.lanes[lane].successors)
            lane = next(iter(reachable), lane)
        for here, following in pairwise(route[index + (self._road.lanes[lane].edge != route[index]) :]):
            options = self._links_between.get((here, following), ())
            links = [k for k in options if self._road.links[k].origin in reachable] or options
            if here in edges:
                return links
            reachable = {self._road.links[k].target for k in links}
        return ()

    @cached_property
    def _approaches(self) -> Callable[[int], tuple[tuple[int, float], ...]]:
        """The lanes before the lines of a link's foes; for each, the position (m) from which a vehicle is
        within `within` m of the line."""
        return cache(self._approach_lanes)

    @cached_property
    def _links_between(self) -> dict[tuple[str, str], list[int]]:
        """(edge, edge) -> the links between them."""
        found: dict[tuple[str, str], list[int]] = {}
        for k, link in enumerate(self._road.links):
            edges = self._road.lanes[link.origin].edge, self._road.lanes[link.target].edge
            found.setdefault(edges, []).append(k)
        return found

    def _approach_lanes(self, link_index: int) -> tuple[tuple[int, float], ...]:
        lanes, links = self._road.lanes, self._road.links
        covered: dict[str, float] = {}  # edge -> m of its end that are in range
        waiting = [(lanes[links[foe].origin].edge, self._within) for foe in links[link_index].foes]
        while waiting:
            edge, reach = waiting.pop()
            if reach <= covered.get(edge, 0.0):
                continue
            covered[edge] = reach
            for lane in self._road.lanes_of[edge]:
                more = reach - lanes[lane].length
                waiting += [(lanes[origin].edge, more) for origin in self._road.before[lane]]
        inside = lanes[links[link_index].via].start if links[link_index].via >= 0 else ""
        return tuple(
            (lane, lanes[lane].length - reach)
            for edge, reach in covered.items()
            for lane in self._road.lanes_of[edge]
            if not (lanes[lane].internal and lanes[lane].start == inside)
        )
