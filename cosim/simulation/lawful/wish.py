"""The agent's wish, driven comfortably."""

import math

from cosim.control import COMFORT_TIME_CONSTANT, wished_accel
from cosim.simulation.backend import sumo
from cosim.simulation.lawful.car import NO_LIMIT, Car, Limit, Rule

MIN_JUNCTION_SPEED = 3.0  # m/s, the lowest wish obeyed inside a junction, or for longer than `PATIENCE`
PATIENCE = 10.0  # s
LONG_WAIT = 15.0  # s at a line to give way, after which the AV goes when it can, whatever the agent asks
CROSSING_TIME = 5.0  # s after a crossing where it gave way: the AV drives as fast as gap acceptance assumed


class Wish(Rule):
    """Limits the acceleration to the agent's request; `step`: s of a simulation step."""

    def __init__(self, step: float) -> None:
        self._step = step
        self._slow_time: dict[str, float] = {}  # AV -> s of wishes below `MIN_JUNCTION_SPEED`
        self._last_crossing: dict[str, float] = {}  # AV -> s, last inside a junction where it gave way

    def limit(self, car: Car) -> Limit:
        """The wish; no limit during an evasion from the follower, or on the way through an accepted gap."""
        crosses = car.in_junction and car.gives_way
        if crosses:
            self._last_crossing[car.name] = car.now
        hurries = car.now - self._last_crossing.get(car.name, -math.inf) < CROSSING_TIME
        slow = self._slow_time.get(car.name, 0.0)
        self._slow_time[car.name] = slow + self._step if car.target < MIN_JUNCTION_SPEED else 0.0
        target = min(car.tracked_target(car.speed, COMFORT_TIME_CONSTANT), car.limit)
        if car.evading:
            target = math.inf
        elif hurries or car.waiting_time > LONG_WAIT:
            target = car.limit
        elif car.in_junction or slow > PATIENCE:
            target = max(target, min(MIN_JUNCTION_SPEED, car.limit))
        target = min(target, sumo.vehicle.getAllowedSpeed(car.name))
        last_accel = car.commanded_accel if car.commanded else (car.speed - car.last_speed) / self._step
        car.wished, accel = wished_accel(car.speed, target, last_accel, self._step)
        return NO_LIMIT if car.evading or crosses else Limit(accel)

    def drop(self, name: str) -> None:
        """The AV is no longer commanded."""
        self._slow_time.pop(name, None)
        self._last_crossing.pop(name, None)
