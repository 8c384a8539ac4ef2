"""Lines at which the AV gives way.

SUMO's driver keeps the right of way. Who has waited long takes a gap of its own choice (`gaps.py`); between
AVs one lets the other in, and none goes before one that would have to brake hard (V2V).
"""

from collections.abc import Mapping
from functools import partial

from cosim.control import COMFORT
from cosim.road import RoadMap
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import FREE, Car, Limit, Rule
from cosim.simulation.lawful.driver import Driver
from cosim.simulation.lawful.gaps import Gaps
from cosim.simulation.lawful.inside import Inside
from cosim.simulation.lawful.wish import KEEPS_MOVING, PATIENCE, WAITS

STOPS_SHORT = 0.5  # m before its line
DECIDES = 30.0  # m before a line at which it gives way: from there on it looks who comes
COMES = 100.0  # m from which they come, however many edges that are
AT_LINE = 5.0  # m: who is further away stands in a queue
HOLDS = 10.0, 2.6  # m before a line, m/s2: from there on it goes before no AV that would brake harder
LETS = 1.0  # s for which an AV that is asked lets another one in
GENTLY = 2.0  # m/s2, with which who lets in can stop before its line
# where AVs alone come, and where humans do: SUMO adds a share of 180 s stood, which makes humans brake hard
IMPATIENCE = 0.8, -1.0


class Crossing(Rule):
    """Limits the acceleration before a line where the AV holds, or lets another one in."""

    def __init__(
        self, fleet: Mapping[str, Car], driver: Driver, road: RoadMap, eyes: Eyes, inside: Inside, step: float
    ) -> None:
        self._fleet, self._driver, self._eyes, self._step = fleet, driver, eyes, step
        self._gaps = Gaps(road, inside, eyes)
        self._lane: dict[str, str] = {}  # AV -> the lane from which it takes its gap
        self._has_let: dict[str, float] = {}  # AV -> s, for which it has let others in at this line
        self._ways: dict[str, tuple[frozenset[str], frozenset[str]]] = {}  # edge -> `_ways_beside`

    def look(self, car: Car, period: float) -> None:
        """Look ahead who has to give way, every `period` s."""
        if not car.lane:
            return
        red, via = False, ""
        if not car.inside:
            links = sumo.vehicle.getNextLinks(car.name)
            car.gives_way = bool(links) and not links[0][1]
            red = bool(links) and links[0][5] in RED + YELLOW
            via = links[0][4] if links else ""
        self._wait(car, red, period)
        self._take_gap(car, via)
        car.holds = car.gives_way and not (red or car.goes) and self._holds(car, via)

    def limit(self, car: Car) -> Limit:
        """A comfortable stop before the line."""
        lets = car.now < car.lets_in_until
        if car.inside:
            self._has_let[car.name] = 0.0
        elif car.lane and (lets or car.holds):
            self._has_let[car.name] = self._has_let.get(car.name, 0.0) + self._step * lets
            left = max(car.left - STOPS_SHORT, 0.1)
            return Limit(max(-car.speed * car.speed / (2.0 * left), -COMFORT), "lets an AV in")
        return FREE

    def drop(self, name: str) -> None:
        """It is commanded no more."""
        self._lane.pop(name, None)
        self._has_let.pop(name, None)

    # ---- inside ----

    def _wait(self, car: Car, red: bool, period: float) -> None:
        """Before humans it waits for a gap that nobody brakes for; AVs see it, and brake comfortably.

        Inside a junction too: there those wait who turn across others. At a red light nobody waits for a gap.
        """
        waits = car.gives_way and not red and car.left < AT_LINE and car.speed < KEEPS_MOVING
        car.waited = car.waited + period if waits else 0.0
        humans = car.gives_way and car.left <= DECIDES and self._meets_humans(car.name)
        self._driver.be_impatient(car.name, IMPATIENCE[humans])

    def _take_gap(self, car: Car, via: str) -> None:
        """Who has waited long at a line without a signal, or in the junction behind it, judges its gap
        itself; AVs let it in."""
        if car.goes and car.inside and car.lane != self._lane[car.name]:  # until it has left the junction
            return
        goes = False
        if car.waited > WAITS:
            goes, asked = self._gaps.take(car.name, car.lane, via, partial(self._lets_in, car.name))
            for other in asked:
                self._fleet[other].lets_in_until = car.now + LETS
        if goes != car.goes:
            car.goes, self._lane[car.name] = goes, car.lane
            self._driver.go_first(car.name, goes, car.inside)

    def _holds(self, car: Car, via: str) -> bool:
        """Whether one that gives way there waits for AVs that would have to brake hard for it (V2V)."""
        near, hard = HOLDS
        if car.left > near or car.speed**2 > 2.0 * COMFORT * max(car.left - STOPS_SHORT, 0.1):
            return False
        return self._gaps.brakes(car.name, car.lane, via, self._step, partial(self._comes, car.name)) > hard

    def _comes(self, asks: str, name: str) -> bool:
        """Whether it is an AV that lets nobody in, as far as the one that `asks` hears of it."""
        car = self._fleet.get(name)
        return car is not None and self._eyes.hears(asks, name) and car.lets_in_until < car.now

    def _lets_in(self, asks: str, name: str, before: float) -> bool | None:
        """Whether it is an AV that can stop comfortably so many m before its line, and has not for long; None
        for an AV that takes its own gap. It and the one that `asks` must hear one another."""
        car = self._fleet.get(name)
        if not (self._eyes.hears(asks, name) and self._eyes.hears(name, asks)):
            return False
        if car is not None and car.goes:
            return None
        if car is None or self._has_let.get(name, 0.0) >= PATIENCE or car.makes_room:
            return False
        needs = sumo.vehicle.getSpeed(name) ** 2 / (2.0 * GENTLY)  # m
        return bool(needs <= max(before - 2.0 * STOPS_SHORT, 0.0))

    def _meets_humans(self, name: str) -> bool:
        """Whether anybody but AVs comes to the junction that it is at, from elsewhere.

        `getJunctionFoes` leaves out some who have priority.
        """
        get = sumo.vehicle
        own = get.getRoute(name)[max(get.getRouteIndex(name), 0)]
        if own not in self._ways:
            self._ways[own] = _ways_beside(own)
        near, further = self._ways[own]
        for edges, comes in ((near, True), (further, False)):
            for edge in edges:
                for other in self._eyes.known(name, sumo.edge.getLastStepVehicleIDs(edge)):
                    human = not self._eyes.is_av(name, other, self._fleet)
                    if human and (comes or near & set(_route_ahead(other))):
                        return True
        return False


def _ways_beside(own: str) -> tuple[frozenset[str], frozenset[str]]:
    """The edges that lead to the junction at the end of `own`, its inner ones too, but for `own`; and those
    before them from which it is at most `COMES`."""
    junction = sumo.edge.getToJunction(own)
    near = frozenset(sumo.junction.getIncomingEdges(junction)) - {own}
    further: set[str] = set()
    waiting = [(edge, 0.0) for edge in near if not edge.startswith(":")]
    while waiting:
        edge, away = waiting.pop()
        away += float(sumo.lane.getLength(f"{edge}_0"))
        before = sumo.edge.getFromJunction(edge)
        if away >= COMES or before == junction:
            continue
        new = set(sumo.junction.getIncomingEdges(before)) - near - further - {own}
        further |= new
        waiting += [(edge, away) for edge in new if not edge.startswith(":")]
    return near, frozenset(further)


def _route_ahead(name: str) -> tuple[str, ...]:
    """The edges that a vehicle still comes to."""
    return tuple(sumo.vehicle.getRoute(name))[max(sumo.vehicle.getRouteIndex(name), 0) + 1 :]
