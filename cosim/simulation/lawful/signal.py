"""Yellow signals: the AV stops if it comfortably can, as the law asks.

SUMO's driver adds its headway to its braking distance, and drives on where a comfortable stop was possible.
"""

from cosim.road import RoadMap
from cosim.road.rules import COMFORT_DECEL, RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.lawful.car import NO_LIMIT, STOP_MARGIN, Car, Limit, Rule


class Signal(Rule):
    """Limits the acceleration before a signal that has turned yellow; `step`: s of a simulation step."""

    def __init__(self, road: RoadMap, step: float) -> None:
        self._lanes = {road.lanes[link.origin].id for link in road.links if link.signal >= 0}
        self._step = step
        self._stops: dict[str, bool] = {}  # AV -> whether it could stop when its signal turned yellow

    def limit(self, car: Car) -> Limit:
        """A stop before the line until green, if the AV could stop when its signal turned yellow."""
        if car.lane not in self._lanes:
            self._stops.pop(car.name, None)
            return NO_LIMIT
        links = sumo.vehicle.getNextLinks(car.name)
        state = links[0][5] if links else "-"
        if state in YELLOW:
            braking = car.speed * car.speed / (2.0 * COMFORT_DECEL)  # m; one step ago the signal was green
            self._stops.setdefault(car.name, braking <= car.to_line + car.speed * self._step)
        elif state not in RED:
            self._stops.pop(car.name, None)
        if not self._stops.get(car.name, False):
            return NO_LIMIT
        distance = max(car.to_line - STOP_MARGIN, 0.1)
        return Limit(-car.speed * car.speed / (2.0 * distance), "yellow light")

    def drop(self, name: str) -> None:
        """The AV is no longer commanded."""
        self._stops.pop(name, None)
