"""Whoever drives ahead: brake gently for what begins beyond the leader, and follow him as he is believed.

Behind an AV that brakes early and gently nobody has to brake hard. How much braking beyond the leader asks
for is judged as in the multi-anticipative driver models (Treiber, Kesting and Helbing, "Delays, inaccuracies
and anticipation in microscopic traffic models", Physica A 360, 2006).
"""

import math

from cosim.control import COMFORT, MAX_DECEL
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import FREE, LAW, Car, Limit, Rule

REACH = 120.0  # m ahead in which it looks
BEYOND = 3  # vehicles beyond the leader that it looks at, as far as it knows of them
GENTLY = 1.0  # m/s2: what asks for less braking is left to the leader's own braking
SOON = 1.0  # s, for which a vehicle ahead is taken to brake on
SPACE = 2.0  # m that each vehicle between takes besides its length, when all stand


class Leader(Rule):
    """Limits the acceleration behind the vehicles ahead; `step`: s of a simulation step."""

    def __init__(self, eyes: Eyes, step: float) -> None:
        self._eyes = eyes
        self._step = step

    def limit(self, car: Car) -> Limit:
        """The stricter of what the leader and what those beyond him ask for."""
        leader, gap = sumo.vehicle.getLeader(car.name, REACH) or ("", 0.0)
        if not leader or not self._eyes.known(car.name, [leader]):
            return FREE
        return min(self._follow(car, leader, gap), self._anticipate(car, leader, gap))

    # ---- inside ----

    def _follow(self, car: Car, leader: str, gap: float) -> Limit:
        """The driver model's speed `gap` m behind the leader as the AV sees him.

        SUMO's driver heeds him too where everything is known, and brakes no harder than it must; a command
        would make it brake as the model says. Else it heeds nobody ahead, and the command is ours.
        """
        get, seen = sumo.vehicle, self._eyes.of(car.name)
        if not self._eyes.ideal:
            gap -= seen.behind_by(leader, math.radians(90.0 - get.getAngle(car.name)))
        theirs = seen.getSpeed(leader)
        wanted = get.getFollowSpeed(car.name, car.speed, gap, theirs, get.getDecel(leader), leader)
        accel = (wanted - car.speed) / self._step
        if self._eyes.ideal:
            return Limit(accel, LAW)
        must = max(car.speed - theirs, 0.0) ** 2 / (2.0 * max(gap, 0.1))  # m/s2
        return Limit(max(accel, -max(get.getDecel(car.name), must), -MAX_DECEL), "vehicle ahead")

    def _anticipate(self, car: Car, leader: str, gap: float) -> Limit:
        """The braking with which the AV is as slow as each vehicle beyond its leader when it is behind it."""
        get, seen = sumo.vehicle, self._eyes.of(car.name)
        name, room, hardest = leader, gap, GENTLY
        for _ in range(BEYOND):
            ahead, gap = get.getLeader(name, REACH) or ("", 0.0)
            # SUMO's gap is less by the follower's minGap
            room += gap + get.getMinGap(name) - SPACE
            if not ahead or room > REACH or not self._eyes.known(car.name, [ahead]):
                break
            slower = min(seen.getAcceleration(ahead), 0.0) * SOON
            closing = car.speed - max(seen.getSpeed(ahead) + slower, 0.0)
            if closing > 0.0:
                hardest = max(hardest, closing**2 / (2.0 * max(room, 1.0)))
            name = ahead
        return FREE if hardest == GENTLY else Limit(-min(hardest, COMFORT), "traffic ahead")
