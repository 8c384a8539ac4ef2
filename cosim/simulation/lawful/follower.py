"""A human close behind may not be looking: when he closes in without braking, the car makes room.

It uses up the distance to its leader, and brakes later and harder, until he brakes. AVs ahead of it are told
(V2V) and make room too, before the end of their queue has used up its own.
"""

import math
from collections.abc import Mapping

from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import FREE, Car, Limit, Rule
from cosim.simulation.lawful.driver import Driver

BEHIND = 60.0  # m in which it looks
HEADWAY = 0.8  # s to the leader
STANDS = 2.0, 5.0  # m to a standing leader; with a human that close behind: the room that there is to use up,
USES_UP = 1.0  # m to him when it is
CLOSES = 3.0, 0.5  # s to contact, and the share of the braking that would avoid it of who heeds
ASKED = 2.0, 0.5  # m/s2 that would avoid it: from there on the car makes room; goes on doing so
ROOM = (1.5, 0.2), (3.0, 0.5)  # s to contact, s to the leader that it makes do with; between them linear
LASTS = 1.0  # s at least
TOLD = 8.0, 30.0  # s to contact of the AVs ahead that are told, m between one vehicle and the next up to them
RETURNS = 0.1  # s of headway won back per s


class Follower(Rule):
    """Limits nothing: it sets the headway, and says whether the wish counts."""

    def __init__(self, fleet: Mapping[str, Car], driver: Driver, eyes: Eyes, step: float) -> None:
        self._fleet, self._driver, self._eyes, self._step = fleet, driver, eyes, step
        self._standing_gaps: dict[str, float] = {}  # human -> m
        # AV -> s until somebody further behind, who does not brake, would be there
        self._told: dict[str, float] = {}
        self._heard = self._told  # in the step before

    def begin(self) -> None:
        """A new step."""
        self._heard, self._told = self._told, {}

    def limit(self, car: Car) -> Limit:
        """Free: how close to its leader the car may come is the leader's rule."""
        headway = car.headway
        human = self._human(car)
        heard = self._heard.get(car.name, math.inf)
        contact = heard if human is None else min(self._contact(car, *human), heard)
        if contact < math.inf:
            car.room_until = car.now + LASTS
            (soon, shortest), (later, most) = ROOM
            share = min(max((contact - soon) / (later - soon), 0.0), 1.0)
            headway = min(shortest + share * (most - shortest), headway)
        elif not car.makes_room:
            headway = min(headway + RETURNS * self._step, HEADWAY)
        late = headway < HEADWAY
        car.headway, car.stands = headway, USES_UP if late else STANDS[human is not None]
        self._driver.brake_late(car.name, late)
        return FREE

    # ---- inside ----

    def _human(self, car: Car) -> tuple[str, float] | None:
        """The vehicle behind that is no AV, as far as this one knows of it, and m to it."""
        follower, gap = sumo.vehicle.getFollower(car.name, BEHIND)
        if not follower or self._eyes.is_av(car.name, follower, self._fleet):
            return None
        if not self._eyes.known(car.name, [follower]):
            return None
        gap += self._standing_gap(follower)
        if not self._eyes.ideal:
            heading = math.radians(90.0 - sumo.vehicle.getAngle(car.name))
            gap += self._eyes.of(car.name).behind_by(follower, heading)
        return follower, max(gap, 0.1)

    def _contact(self, car: Car, follower: str, gap: float) -> float:
        """s until a human `gap` m behind is here who does not brake; else inf."""
        seen = self._eyes.of(car.name)
        closing = seen.getSpeed(follower) - car.speed
        if closing <= 0.0 or gap >= CLOSES[0] * closing:
            return math.inf
        asked = closing**2 / (2.0 * gap) + max(-sumo.vehicle.getAcceleration(car.name), 0.0)
        if asked < ASKED[car.makes_room] or -seen.getAcceleration(follower) > CLOSES[1] * asked:
            return math.inf
        self._tell(car.name, seen.getSpeed(follower), gap)
        return float(gap / closing)

    def _tell(self, name: str, fast: float, away: float) -> None:
        """The AVs ahead hear of one who drives `fast` m/s, `away` m behind `name`, whoever is between."""
        get, (soon, apart), told_by = sumo.vehicle, TOLD, name
        while ahead := get.getLeader(name, apart):
            leader, free = ahead
            if not leader or free > apart:
                return
            # SUMO's gap to a leader is less by the follower's minGap
            away += get.getLength(name) + get.getMinGap(name) + free
            closing = fast - get.getSpeed(leader)
            if closing <= 0.0 or away > soon * closing:
                return
            if self._eyes.hears(leader, told_by):
                self._told[leader] = min(away / closing, self._told.get(leader, math.inf))
            name = leader

    def _standing_gap(self, name: str) -> float:
        """m, which SUMO takes off a follower's gap."""
        found = self._standing_gaps.get(name)
        if found is None:
            found = self._standing_gaps[name] = float(sumo.vehicle.getMinGap(name))
        return found
