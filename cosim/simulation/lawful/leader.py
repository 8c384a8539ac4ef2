"""Whoever drives ahead: brake gently for what begins beyond the leader, and follow him as he is believed.

Behind an AV that brakes early and gently nobody has to brake hard. How much braking beyond the leader asks
for is judged as in the multi-anticipative driver models (Treiber, Kesting and Helbing, "Delays, inaccuracies
and anticipation in microscopic traffic models", Physica A 360, 2006).
"""

import math

from cosim.control import COMFORT, MAX_DECEL
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import FREE, Car, Limit, Rule

REACH = 120.0  # m ahead in which it looks
AHEAD = 4  # vehicles ahead that it looks at, as far as it knows of them
GENTLY = 0.5  # m/s2: what asks for less braking is left to the leader's own braking
SOON = 1.0  # s, for which a vehicle ahead is taken to brake on
SPACE = 2.0  # m that each vehicle between takes besides its length, when all stand


class Leader(Rule):
    """Limits the acceleration behind the vehicles ahead; `step`: s of a simulation step."""

    def __init__(self, eyes: Eyes, step: float) -> None:
        self._eyes = eyes
        self._step = step

    def limit(self, car: Car) -> Limit:
        """The stricter of what the leader and what those beyond him ask for."""
        believed = FREE if self._eyes.ideal else self._follow(car)
        return min(believed, self._anticipate(car))

    # ---- inside ----

    def _follow(self, car: Car) -> Limit:
        """The driver model's speed behind the leader as the AV sees him; SUMO's driver heeds none then."""
        get = sumo.vehicle
        leader, gap = get.getLeader(car.name, REACH) or ("", 0.0)
        if not leader or not self._eyes.known(car.name, [leader]):
            return FREE
        seen = self._eyes.of(car.name)
        gap -= seen.behind_by(leader, math.radians(90.0 - get.getAngle(car.name)))
        wanted = get.getFollowSpeed(
            car.name, car.speed, gap, seen.getSpeed(leader), get.getDecel(leader), leader
        )
        return Limit(max((wanted - car.speed) / self._step, -MAX_DECEL), "vehicle ahead")

    def _anticipate(self, car: Car) -> Limit:
        """The braking with which the AV is as slow as each vehicle beyond its leader when it is behind it."""
        seen, name, room, hardest = self._eyes.of(car.name), car.name, 0.0, GENTLY
        for number in range(AHEAD):
            ahead, gap = sumo.vehicle.getLeader(name, REACH) or ("", 0.0)
            if not ahead or room + gap > REACH or not self._eyes.known(car.name, [ahead]):
                break
            # SUMO's gap is less by the follower's minGap
            room += gap + (sumo.vehicle.getMinGap(name) - SPACE if number else 0.0)
            slower = min(seen.getAcceleration(ahead), 0.0) * SOON
            closing = car.speed - max(seen.getSpeed(ahead) + slower, 0.0)
            if number and closing > 0.0:
                hardest = max(hardest, closing**2 / (2.0 * max(room, 1.0)))
            name = ahead
        return FREE if hardest == GENTLY else Limit(-min(hardest, COMFORT), "traffic ahead")
