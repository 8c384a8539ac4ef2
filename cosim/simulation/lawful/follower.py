"""Evasion from an inattentive human follower, which closes in without braking.

The AV gives up its distance to the leader, and brakes later and harder, until the human brakes. By V2V it
warns the AVs ahead. These evade too, before the queue has used up its gaps.
"""

import math
from collections.abc import Mapping

from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import NO_LIMIT, Car, Limit, Rule
from cosim.simulation.lawful.driver import Driver

FOLLOWER_RANGE = 60.0  # m behind the AV
HEADWAY = 0.8  # s to the leader
STANDSTILL_GAPS = 2.0, 5.0  # m to a standing leader, without and with a human follower in range
EVASION_GAP = 1.0  # m to a standing leader during an evasion
INATTENTION = 3.0, 0.5  # s to contact; share of the necessary braking below which the human is inattentive
EVASION_DECELS = 2.0, 0.5  # m/s2 of necessary braking, from which an evasion begins, and goes on
EVASION_HEADWAYS = (1.5, 0.2), (3.0, 0.5)  # (s to contact, s of headway), linear in between
MIN_EVASION_TIME = 1.0  # s
WARNING_RANGE = 8.0, 30.0  # s to contact of a warned AV; m, the largest gap in the queue up to it
HEADWAY_RECOVERY = 0.1  # s of headway regained per s
ESTIMATE_LAG = 0.5  # s by which estimates of a human's braking lag, unless sensing is ideal


class Follower(Rule):
    """Sets headways and evasions of the AVs; limits no acceleration itself."""

    def __init__(self, fleet: Mapping[str, Car], driver: Driver, eyes: Eyes, step: float) -> None:
        self._fleet, self._driver, self._eyes, self._step = fleet, driver, eyes, step
        self._min_gaps: dict[str, float] = {}  # human -> m, SUMO's minGap
        # AV -> s until contact with an inattentive human further back
        self._new_warnings: dict[str, float] = {}
        self._warnings = self._new_warnings  # of the previous step
        self._suspected: dict[str, tuple[str, float]] = {}  # AV -> human that seems inattentive, since s

    def begin_step(self) -> None:
        """Begin a simulation step."""
        self._warnings, self._new_warnings = self._new_warnings, {}

    def limit(self, car: Car) -> Limit:
        """No limit: the leader rule applies the headway that is set here."""
        headway = car.headway
        human = self._human_follower(car)
        if human is None:
            self._suspected.pop(car.name, None)
        warned = self._warnings.get(car.name, math.inf)
        contact = warned if human is None else min(self._time_to_contact(car, *human), warned)
        if contact < math.inf:
            car.evasion_until = car.now + MIN_EVASION_TIME
            (soon, shortest), (later, most) = EVASION_HEADWAYS
            share = min(max((contact - soon) / (later - soon), 0.0), 1.0)
            headway = min(shortest + share * (most - shortest), headway)
        elif not car.evading:
            headway = min(headway + HEADWAY_RECOVERY * self._step, HEADWAY)
        late = headway < HEADWAY
        car.headway, car.standstill_gap = headway, EVASION_GAP if late else STANDSTILL_GAPS[human is not None]
        self._driver.set_late_braking(car.name, late)
        return NO_LIMIT

    def drop(self, name: str) -> None:
        """The AV is no longer commanded."""
        self._suspected.pop(name, None)

    # ---- inside ----

    def _human_follower(self, car: Car) -> tuple[str, float] | None:
        """The human follower that the AV knows of, and its gap in m."""
        follower, gap = sumo.vehicle.getFollower(car.name, FOLLOWER_RANGE)
        if not follower or self._eyes.is_av(car.name, follower, self._fleet):
            return None
        if not self._eyes.known(car.name, [follower]):
            return None
        gap += self._min_gap(follower)
        if not self._eyes.ideal:
            heading = math.radians(90.0 - sumo.vehicle.getAngle(car.name))
            gap += self._eyes.view(car.name).position_lag(follower, heading)
        return follower, max(gap, 0.1)

    def _time_to_contact(self, car: Car, follower: str, gap: float) -> float:
        """s until contact with an inattentive human `gap` m behind; inf if the human brakes or is slower."""
        speed = self._eyes.view(car.name).getSpeed(follower)
        closing = speed - car.speed
        near = closing > 0.0 and gap < INATTENTION[0] * closing
        if not near or not self._is_inattentive(car, follower, closing, gap):
            self._suspected.pop(car.name, None)
            return math.inf
        whose, since = self._suspected.get(car.name, (follower, car.now))
        since = since if whose == follower else car.now
        self._suspected[car.name] = follower, since
        if car.now - since < ESTIMATE_LAG and not (self._eyes.ideal or car.evading):
            return math.inf
        self._warn_avs_ahead(car.name, speed, gap)
        return float(gap / closing)

    def _is_inattentive(self, car: Car, follower: str, closing: float, gap: float) -> bool:
        """Whether the human, `gap` m behind and `closing` (m/s), brakes too little to avoid contact."""
        braking = -self._eyes.view(car.name).getAcceleration(follower)
        needed = closing**2 / (2.0 * gap) + max(-sumo.vehicle.getAcceleration(car.name), 0.0)
        return bool(needed >= EVASION_DECELS[car.evading] and braking <= INATTENTION[1] * needed)

    def _warn_avs_ahead(self, name: str, speed: float, distance: float) -> None:
        """Warn the AVs ahead, past other vehicles, of a human at `speed` m/s, `distance` m behind `name`."""
        get, (soon, apart), sender = sumo.vehicle, WARNING_RANGE, name
        while ahead := get.getLeader(name, apart):
            leader, free = ahead
            if not leader or free > apart:
                return
            # SUMO's gap to a leader is net of the follower's minGap
            distance += get.getLength(name) + get.getMinGap(name) + free
            closing = speed - get.getSpeed(leader)
            if closing <= 0.0 or distance > soon * closing:
                return
            if self._eyes.hears(leader, sender):
                self._new_warnings[leader] = min(distance / closing, self._new_warnings.get(leader, math.inf))
            name = leader

    def _min_gap(self, name: str) -> float:
        """The minGap (m) that SUMO subtracts from a follower's gap."""
        found = self._min_gaps.get(name)
        if found is None:
            found = self._min_gaps[name] = float(sumo.vehicle.getMinGap(name))
        return found
