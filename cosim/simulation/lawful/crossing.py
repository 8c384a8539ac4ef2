"""Stop lines at which the AV gives way.

SUMO's driver keeps the right of way. After a long wait the AV accepts a gap of its own choice (`gaps.py`). By
V2V, AVs with priority admit a waiting AV, and an AV without priority makes no other AV brake hard.
"""

from collections.abc import Mapping
from functools import partial

from cosim.control import COMFORT_ACCEL
from cosim.road import RoadMap
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import NO_LIMIT, STOP_MARGIN, Car, Limit, Rule
from cosim.simulation.lawful.driver import Driver
from cosim.simulation.lawful.gaps import Gaps
from cosim.simulation.lawful.inside import Inside
from cosim.simulation.lawful.wish import LONG_WAIT, MIN_JUNCTION_SPEED, PATIENCE

DECISION_DISTANCE = 30.0  # m before the stop line, from which the AV looks for humans with priority
APPROACH_RANGE = 100.0  # m, the length of the approaches that are searched, over any number of edges
HEAD_OF_QUEUE = 5.0  # m to the line: a vehicle further away is queueing
HOLD_LIMITS = 10.0, 2.6  # m to the line, and m/s2: the AV enters before no AV that would brake harder
ADMISSION_TIME = 1.0  # s for which an AV stops, once another AV has asked to be admitted
YIELD_DECEL = 2.0  # m/s2: an AV admits another AV only if this braking stops it before its own line
# SUMO's impatience if only AVs approach, and with humans (-1 cancels what SUMO adds for time spent waiting)
IMPATIENCE = 0.8, -1.0


class Crossing(Rule):
    """Limits the acceleration before a line where the AV waits for an AV, or admits one."""

    def __init__(
        self, fleet: Mapping[str, Car], driver: Driver, road: RoadMap, eyes: Eyes, inside: Inside, step: float
    ) -> None:
        self._fleet, self._driver, self._eyes, self._step = fleet, driver, eyes, step
        self._gaps = Gaps(road, inside, eyes)
        self._gap_lane: dict[str, str] = {}  # AV -> the lane from which it accepts a gap
        self._admission_time: dict[str, float] = {}  # AV -> s for which it has admitted others at this line
        self._approaches: dict[str, tuple[frozenset[str], frozenset[str]]] = {}  # edge -> `_approach_edges`

    def update(self, car: Car, period: float) -> None:
        """Check the right of way ahead, every `period` s."""
        if not car.lane:
            return
        red, via = False, ""
        if not car.in_junction:
            links = sumo.vehicle.getNextLinks(car.name)
            car.gives_way = bool(links) and not links[0][1]
            red = bool(links) and links[0][5] in RED + YELLOW
            via = links[0][4] if links else ""
        self._update_waiting(car, red, period)
        self._take_gap(car, via)
        car.held_for_av = car.gives_way and not (red or car.takes_gap) and self._must_hold(car, via)

    def limit(self, car: Car) -> Limit:
        """A comfortable stop before the line."""
        admitting = car.now < car.admission_until
        if car.in_junction:
            self._admission_time[car.name] = 0.0
        elif car.lane and (admitting or car.held_for_av):
            self._admission_time[car.name] = self._admission_time.get(car.name, 0.0) + self._step * admitting
            distance = max(car.to_line - STOP_MARGIN, 0.1)
            return Limit(max(-car.speed * car.speed / (2.0 * distance), -COMFORT_ACCEL), "lets an AV in")
        return NO_LIMIT

    def drop(self, name: str) -> None:
        """The AV is no longer commanded."""
        self._gap_lane.pop(name, None)
        self._admission_time.pop(name, None)

    # ---- inside ----

    def _update_waiting(self, car: Car, red: bool, period: float) -> None:
        """Count the waiting time, and set the impatience of SUMO's driver.

        AVs with priority may have to brake comfortably, humans not at all. A left turner also waits inside.
        """
        waiting = car.gives_way and not red and car.to_line < HEAD_OF_QUEUE and car.speed < MIN_JUNCTION_SPEED
        car.waiting_time = car.waiting_time + period if waiting else 0.0
        humans = car.gives_way and car.to_line <= DECISION_DISTANCE and self._humans_approach(car.name)
        self._driver.set_impatience(car.name, IMPATIENCE[humans])

    def _take_gap(self, car: Car, via: str) -> None:
        """Accept a gap after a long wait, at a line without a signal or inside the junction; AVs with
        priority admit the AV."""
        if car.takes_gap and car.in_junction and car.lane != self._gap_lane[car.name]:  # still crossing
            return
        accepted = False
        if car.waiting_time > LONG_WAIT:
            accepted, asked = self._gaps.accept(car.name, car.lane, via, partial(self._can_admit, car.name))
            for other in asked:
                self._fleet[other].admission_until = car.now + ADMISSION_TIME
        if accepted != car.takes_gap:
            car.takes_gap, self._gap_lane[car.name] = accepted, car.lane
            self._driver.set_priority(car.name, accepted, car.in_junction)

    def _must_hold(self, car: Car, via: str) -> bool:
        """Whether the AV waits, because AVs with priority would have to brake hard (V2V)."""
        distance, hard = HOLD_LIMITS
        if car.to_line > distance or car.speed**2 > 2.0 * COMFORT_ACCEL * max(car.to_line - STOP_MARGIN, 0.1):
            return False
        return self._gaps.braking(car.name, car.lane, via, self._step, partial(self._is_foe, car.name)) > hard

    def _is_foe(self, other: str, name: str) -> bool:
        """Whether `name` is an AV that admits no other AV, as far as `other` knows by V2V."""
        car = self._fleet.get(name)
        return car is not None and self._eyes.hears(other, name) and car.admission_until < car.now

    def _can_admit(self, other: str, name: str, distance: float) -> bool | None:
        """Whether `name` is an AV that can stop within `distance` m and has not admitted others too long;
        None if it accepts a gap itself. Both AVs must receive each other's messages."""
        car = self._fleet.get(name)
        if not (self._eyes.hears(other, name) and self._eyes.hears(name, other)):
            return False
        if car is not None and car.takes_gap:
            return None
        if car is None or self._admission_time.get(name, 0.0) >= PATIENCE or car.evading:
            return False
        needed = sumo.vehicle.getSpeed(name) ** 2 / (2.0 * YIELD_DECEL)  # m
        return bool(needed <= max(distance - 2.0 * STOP_MARGIN, 0.0))

    def _humans_approach(self, name: str) -> bool:
        """Whether a human approaches the junction ahead of `name` on another edge.

        `getJunctionFoes` omits some vehicles with priority.
        """
        get = sumo.vehicle
        own = get.getRoute(name)[max(get.getRouteIndex(name), 0)]
        if own not in self._approaches:
            self._approaches[own] = _approach_edges(own)
        near, further = self._approaches[own]
        for edges, certain in ((near, True), (further, False)):
            for edge in edges:
                for other in self._eyes.known(name, sumo.edge.getLastStepVehicleIDs(edge)):
                    human = not self._eyes.is_av(name, other, self._fleet)
                    if human and (certain or near & set(_route_ahead(other))):
                        return True
        return False


def _approach_edges(own: str) -> tuple[frozenset[str], frozenset[str]]:
    """The edges that lead to the junction at the end of `own`, without `own` but with internal edges; and the
    edges before those, up to `APPROACH_RANGE` away."""
    junction = sumo.edge.getToJunction(own)
    near = frozenset(sumo.junction.getIncomingEdges(junction)) - {own}
    further: set[str] = set()
    waiting = [(edge, 0.0) for edge in near if not edge.startswith(":")]
    while waiting:
        edge, away = waiting.pop()
        away += float(sumo.lane.getLength(f"{edge}_0"))
        before = sumo.edge.getFromJunction(edge)
        if away >= APPROACH_RANGE or before == junction:
            continue
        new = set(sumo.junction.getIncomingEdges(before)) - near - further - {own}
        further |= new
        waiting += [(edge, away) for edge in new if not edge.startswith(":")]
    return near, frozenset(further)


def _route_ahead(name: str) -> tuple[str, ...]:
    """The remaining edges of a vehicle's route, after the present edge."""
    return tuple(sumo.vehicle.getRoute(name))[max(sumo.vehicle.getRouteIndex(name), 0) + 1 :]
