"""What the agent wishes, driven comfortably."""

import math

from cosim.control import COMFORT_TIME, wished_accel
from cosim.simulation.backend import sumo
from cosim.simulation.lawful.car import FREE, Car, Limit, Rule

KEEPS_MOVING = 3.0  # m/s: no slower wish is followed inside a junction, nor for longer than `PATIENCE`
PATIENCE = 10.0  # s
WAITS = 15.0  # s at a line, to give way: from then on the car goes when it can, whatever the agent asks for
CROSSES = 5.0  # s behind a junction where it gave way, in which it drives as fast as its gap was judged by


class Wish(Rule):
    """Limits the acceleration to what the agent asks for; `step`: s of a simulation step."""

    def __init__(self, step: float) -> None:
        self._step = step
        self._slow: dict[str, float] = {}  # AV -> s of wishes below `KEEPS_MOVING`
        self._crossed: dict[str, float] = {}  # AV -> s, when last inside where it gave way

    def limit(self, car: Car) -> Limit:
        """Free where the car hurries: out of the way of the one behind, or through the gap that it took."""
        crosses = car.inside and car.gives_way
        if crosses:
            self._crossed[car.name] = car.now
        hurries = car.now - self._crossed.get(car.name, -math.inf) < CROSSES
        slow = self._slow.get(car.name, 0.0)
        self._slow[car.name] = slow + self._step if car.target < KEEPS_MOVING else 0.0
        target = min(car.goal(car.speed, COMFORT_TIME), car.limit)
        if car.makes_room:
            target = math.inf
        elif hurries or car.waited > WAITS:
            target = car.limit
        elif car.inside or slow > PATIENCE:
            target = max(target, min(KEEPS_MOVING, car.limit))
        target = min(target, sumo.vehicle.getAllowedSpeed(car.name))
        course = car.accel if car.commanded else (car.speed - car.before) / self._step
        car.raw, accel = wished_accel(car.speed, target, course, self._step)
        return FREE if car.makes_room or crosses else Limit(accel)

    def drop(self, name: str) -> None:
        """It is commanded no more."""
        self._slow.pop(name, None)
        self._crossed.pop(name, None)
