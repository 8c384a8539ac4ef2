"""The end of a lane that the AV must leave: it stops early enough to let the vehicle beside it change too.

Where two streams exchange lanes, two vehicles that stand side by side at the ends of their lanes block each
other for ever: neither can change, and neither can drive on. So the AV stops with room ahead. A vehicle
further ahead can change lanes in front of the AV; if the vehicle beside it is behind, the AV drives on and
changes lanes in front of that one.
"""

from dataclasses import dataclass

from cosim.control import COMFORT_ACCEL
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import NO_LIMIT, STOP_MARGIN, Car, Limit, Rule
from cosim.simulation.lawful.driver import Driver
from cosim.simulation.lawful.leader import follow

ROOM = 1.7  # of the AV's length with its gap: a standing driver of SUMO changes lanes only within two
PATIENCE = 3.0  # s of standing, after which the AV uses that room
CRAWLING_SPEED = 1.0  # m/s: a slower vehicle counts as standing


@dataclass(slots=True)
class Wait:
    """An AV on one lane of its route."""

    lane: str
    route: str
    offset: int  # lanes to the left (right: below 0) that it must change before the end of the lane
    standing: float = 0.0  # s


class LaneEnd(Rule):
    """Limits the acceleration before the end of a lane that the AV must leave.

    Args:
        driver: SUMO's driver, which would brake beside a vehicle that keeps it from changing lanes.
        eyes: what the AVs know of other vehicles.
        step: s of a simulation step.
    """

    def __init__(self, driver: Driver, eyes: Eyes, step: float) -> None:
        self._driver, self._eyes, self._step = driver, eyes, step
        self._waits: dict[str, Wait] = {}

    def limit(self, car: Car) -> Limit:
        """A comfortable stop before the end of the lane."""
        if not car.lane or car.in_junction:
            return NO_LIMIT
        length = sumo.vehicle.getLength(car.name) + car.standstill_gap
        stop = self._stop(car, min(ROOM * length, sumo.lane.getLength(car.lane) / 2.0))
        if stop.accel > COMFORT_ACCEL:
            return NO_LIMIT
        wait = self._wait(car)
        if not wait.offset:
            return NO_LIMIT
        if car.speed < CRAWLING_SPEED:
            wait.standing += self._step
        goes_on = wait.standing > PATIENCE and self._is_first(car, wait.offset, length)
        self._driver.set_changes_for_route(car.name, not goes_on)
        return self._stop(car, STOP_MARGIN) if goes_on else stop

    def drop(self, name: str) -> None:
        """The AV is no longer commanded."""
        self._waits.pop(name, None)

    # ---- inside ----

    def _stop(self, car: Car, room: float) -> Limit:
        accel = follow(car, car.to_line - room, 0.0, COMFORT_ACCEL, self._step)
        return Limit(max(accel, -COMFORT_ACCEL), "lane ends")

    def _wait(self, car: Car) -> Wait:
        route, wait = sumo.vehicle.getRouteID(car.name), self._waits.get(car.name)
        if wait is None or (wait.lane, wait.route) != (car.lane, route):
            best = {lane[0]: lane for lane in sumo.vehicle.getBestLanes(car.name)}
            _, _, _, offset, serves, _ = best.get(car.lane, (car.lane, 0.0, 0.0, 0, True, ()))
            wait = self._waits[car.name] = Wait(car.lane, route, 0 if serves else offset)
            self._driver.set_changes_for_route(car.name, True)
        return wait

    def _is_first(self, car: Car, offset: int, length: float) -> bool:
        """Whether a vehicle stands beside the AV, on the lane that it wants, and not further ahead."""
        seen, (edge, _, index) = self._eyes.view(car.name), car.lane.rpartition("_")
        lane = f"{edge}_{int(index) + (1 if offset > 0 else -1)}"
        here = sumo.vehicle.getLanePosition(car.name)
        for other in self._eyes.known(car.name, sumo.lane.getLastStepVehicleIDs(lane)):
            there = seen.getLanePosition(other)
            beside = (here - length, "") < (there, other) < (here, car.name)
            if beside and seen.getSpeed(other) < CRAWLING_SPEED:
                return True
        return False
