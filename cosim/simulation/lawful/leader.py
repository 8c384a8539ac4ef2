"""Whoever drives ahead: follow him, and brake gently for what begins beyond him.

The AV keeps the safe speed of Krauss's model (Krauss, Wagner and Gawron, "Metastable states in a microscopic
model of traffic flow", Physical Review E 55, 1997) with both braking alike, so that its gap is its headway;
an IDM's grows without bound near the speed that it wants. How much braking beyond the leader asks for is
judged as in the multi-anticipative driver models (Treiber, Kesting and Helbing, "Delays, inaccuracies and
anticipation in microscopic traffic models", Physica A 360, 2006).
"""

import math

from cosim.control import COMFORT, MAX_DECEL
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import FREE, Car, Limit, Rule
from cosim.simulation.lawful.waves import Waves

REACH = 120.0  # m ahead in which it looks
BEYOND = 3  # vehicles beyond the leader that it looks at, as far as it knows of them
GENTLY = 1.0  # m/s2: what asks for less braking is left to the leader's own braking
SOON = 1.0  # s, for which a vehicle ahead is taken to brake on
SPACE = 2.0  # m that each vehicle between takes besides its length, when all stand


class Leader(Rule):
    """Limits the acceleration behind the vehicles ahead; `step`: s of a simulation step.

    SUMO's own driver then follows none of them.
    """

    def __init__(self, eyes: Eyes, waves: Waves, step: float) -> None:
        self._eyes, self._waves, self._step = eyes, waves, step

    def limit(self, car: Car) -> Limit:
        """The stricter of what the leader and what those beyond him ask for."""
        ahead = self._ahead(car)
        self._waves.ignore(car.name, [name for name, _ in ahead])
        if not ahead:
            return FREE
        follows = self._follow(car, *ahead[0])
        return follows if car.makes_room else min(follows, self._anticipate(car, ahead[1:]))

    # ---- inside ----

    def _ahead(self, car: Car) -> list[tuple[str, float]]:
        """The leader, with m to him, and those beyond him, with m up to them when all between stand; as far
        as the AV knows of them, and they are on its way: those on others SUMO's driver heeds."""
        get, name, room = sumo.vehicle, car.name, -car.stands
        way = {car.lane.rpartition("_")[0]}
        found: list[tuple[str, float]] = []
        while len(found) <= BEYOND:
            ahead, gap = get.getLeader(name, REACH) or ("", 0.0)
            if not ahead or room + gap > REACH:
                break
            edge = get.getRoadID(ahead)
            if edge not in way:
                way |= _edges_ahead(car.name)
                if edge not in way:
                    break
            # SUMO's gap is less by the follower's minGap
            room += gap + get.getMinGap(name) - (SPACE if found else 0.0)
            if self._eyes.known(car.name, [ahead]):
                found.append((ahead, room))
            elif not found:  # who is not known of leaves his place to the one ahead of him
                room += get.getLength(ahead)
            name = ahead
        return found

    def _follow(self, car: Car, leader: str, gap: float) -> Limit:
        """The safe speed, reached within half the headway; sooner where that takes more than comfort."""
        seen = self._eyes.of(car.name)
        if not self._eyes.ideal:
            gap -= seen.behind_by(leader, math.radians(90.0 - sumo.vehicle.getAngle(car.name)))
        theirs = seen.getSpeed(leader)
        brakes = MAX_DECEL if car.makes_room else COMFORT
        lag = brakes * car.headway  # m/s
        safe = math.sqrt(lag * lag + theirs * theirs + 2.0 * brakes * max(gap, 0.0)) - lag
        accel = (safe - car.speed) / max(0.5 * car.headway, self._step)
        must = max(car.speed - theirs, 0.0) ** 2 / (2.0 * max(gap, 0.1))  # m/s2
        return Limit(max(min(accel, -must) if must > brakes else accel, -MAX_DECEL), "vehicle ahead")

    def _anticipate(self, car: Car, beyond: list[tuple[str, float]]) -> Limit:
        """The braking with which the AV is as slow as each vehicle beyond its leader when it is behind it."""
        seen, hardest = self._eyes.of(car.name), GENTLY
        for name, room in beyond:
            slower = min(seen.getAcceleration(name), 0.0) * SOON
            closing = car.speed - max(seen.getSpeed(name) + slower, 0.0)
            if closing > 0.0:
                hardest = max(hardest, closing**2 / (2.0 * max(room, 1.0)))
        return FREE if hardest == GENTLY else Limit(-min(hardest, COMFORT), "traffic ahead")


def _edges_ahead(name: str) -> set[str]:
    """Those that a vehicle comes to, inside junctions too."""
    links = sumo.vehicle.getNextLinks(name)
    return {lane.rpartition("_")[0] for link in links for lane in (link[0], link[4])}
