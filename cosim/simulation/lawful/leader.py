"""Car following, and early braking for vehicles beyond the leader.

The AV drives at the safe speed of Krauss's model (Krauss, Wagner and Gawron, "Metastable states in a
microscopic model of traffic flow", Physical Review E 55, 1997), with equal braking of both vehicles. So its
gap is its headway, while an IDM's gap grows without bound near the desired speed. Braking for vehicles beyond
the leader follows multi-anticipative driver models (Treiber, Kesting and Helbing, "Delays, inaccuracies and
anticipation in microscopic traffic models", Physica A 360, 2006).
"""

import math

from cosim.control import COMFORT_ACCEL, MAX_DECEL
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import NO_LIMIT, Car, Limit, Rule
from cosim.simulation.lawful.waves import Waves

LEADER_RANGE = 120.0  # m ahead of the AV
VEHICLES_BEYOND_LEADER = 3  # the AV considers at most so many
MIN_BRAKING = 1.0  # m/s2: less anticipated braking is left to the leader
BRAKING_HORIZON = 1.0  # s for which a vehicle ahead is taken to go on braking
SETTLING = 0.25, 0.5  # share of the headway within which the AV speeds up, and slows down, to the safe speed
QUEUE_GAP = 2.0  # m that each vehicle in between takes up besides its length at standstill


class Leader(Rule):
    """Limits the acceleration behind the vehicles ahead; `step`: s of a simulation step.

    SUMO's own driver is told to ignore these vehicles.
    """

    def __init__(self, eyes: Eyes, waves: Waves, step: float) -> None:
        self._eyes, self._waves, self._step = eyes, waves, step

    def limit(self, car: Car) -> Limit:
        """The stricter of the limits behind the leader and behind the vehicles beyond it."""
        ahead = self._vehicles_ahead(car)
        self._waves.ignore_leaders(car.name, [name for name, _ in ahead])
        if not ahead:
            return NO_LIMIT
        follows = self._follow(car, *ahead[0])
        return follows if car.evading else min(follows, self._anticipate(car, ahead[1:]))

    # ---- inside ----

    def _vehicles_ahead(self, car: Car) -> list[tuple[str, float]]:
        """The leader, with the gap in m, and the vehicles beyond it, with the gap if all between stood. They
        are on the AV's route, and the AV knows of them; SUMO's driver follows any other vehicle."""
        get, name, room = sumo.vehicle, car.name, -car.standstill_gap
        way = {car.lane.rpartition("_")[0]}
        found: list[tuple[str, float]] = []
        while len(found) <= VEHICLES_BEYOND_LEADER:
            ahead, gap = get.getLeader(name, LEADER_RANGE) or ("", 0.0)
            if not ahead or room + gap > LEADER_RANGE:
                break
            edge = get.getRoadID(ahead)
            if edge not in way:
                way |= _edges_ahead(car.name)
                if edge not in way:
                    break
            # SUMO's gap is net of the follower's minGap
            room += gap + get.getMinGap(name) - (QUEUE_GAP if found else 0.0)
            if self._eyes.known(car.name, [ahead]):
                found.append((ahead, room))
            elif not found:  # the AV follows the next vehicle that it knows of
                room += get.getLength(ahead)
            name = ahead
        return found

    def _follow(self, car: Car, leader: str, gap: float) -> Limit:
        """The safe speed, reached within part of the headway, sooner if comfortable braking is too weak."""
        seen = self._eyes.view(car.name)
        if not self._eyes.ideal:
            gap -= seen.position_lag(leader, math.radians(90.0 - sumo.vehicle.getAngle(car.name)))
        theirs = seen.getSpeed(leader)
        decel = MAX_DECEL if car.evading else COMFORT_ACCEL
        accel = follow(car, gap, theirs, decel, self._step)
        required = max(car.speed - theirs, 0.0) ** 2 / (2.0 * max(gap, 0.1))  # m/s2
        return Limit(max(min(accel, -required) if required > decel else accel, -MAX_DECEL), "vehicle ahead")

    def _anticipate(self, car: Car, beyond: list[tuple[str, float]]) -> Limit:
        """The braking that makes the AV as slow as each vehicle beyond its leader by the time it is there."""
        seen, hardest = self._eyes.view(car.name), MIN_BRAKING
        for name, room in beyond:
            slower = min(seen.getAcceleration(name), 0.0) * BRAKING_HORIZON
            closing = car.speed - max(seen.getSpeed(name) + slower, 0.0)
            if closing > 0.0:
                hardest = max(hardest, closing**2 / (2.0 * max(room, 1.0)))
        return NO_LIMIT if hardest == MIN_BRAKING else Limit(-min(hardest, COMFORT_ACCEL), "traffic ahead")


def follow(car: Car, gap: float, theirs: float, decel: float, step: float) -> float:
    """The acceleration (m/s2) to the safe speed behind a vehicle.

    Args:
        car: the AV.
        gap: m to that vehicle.
        theirs: its speed, m/s.
        decel: m/s2, how hard both may brake.
        step: s of a simulation step.
    """
    lag = decel * car.headway  # m/s
    safe = math.sqrt(lag * lag + theirs * theirs + 2.0 * decel * max(gap, 0.0)) - lag
    settling = SETTLING[safe < car.speed] * car.headway  # s
    return (safe - car.speed) / max(settling, step)


def _edges_ahead(name: str) -> set[str]:
    """The edges ahead of a vehicle, with internal edges."""
    links = sumo.vehicle.getNextLinks(name)
    return {lane.rpartition("_")[0] for link in links for lane in (link[0], link[4])}
