"""The car of preset `lawful`: the agent wishes within the law, which SUMO's own driver keeps.

Before every simulation step each rule says how much the car may accelerate at most, and why. The smallest
limit is driven and is the reason that an intervention is reported with:

- `wish`: what the agent asks for, comfortably;
- `driver`: SUMO's driver (speed mode 31): signals, right of way, limits, persons. Where it is the slowest, it
  drives by itself, so that it brakes as hard as it must;
- `leader`: following whoever is ahead, and braking early for what begins beyond him;
- `follower`: room for a human behind who does not brake;
- `crossing`: lines at which it gives way;
- `way`: vehicles that stand in its way inside a junction.
"""

import math

from cosim.road import RoadMap
from cosim.simulation.backend import sumo
from cosim.simulation.commands import Commander
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import LAW, Car, Limit, Rule
from cosim.simulation.lawful.crossing import Crossing
from cosim.simulation.lawful.driver import Driver
from cosim.simulation.lawful.follower import Follower
from cosim.simulation.lawful.inside import Inside
from cosim.simulation.lawful.leader import Leader
from cosim.simulation.lawful.waves import Waves
from cosim.simulation.lawful.way import Way
from cosim.simulation.lawful.wish import Wish
from cosim.types import Intervention, Preset, Snapshot

CORRECTED = 1.0  # m/s2 more braking than asked for: from there on the car drives otherwise than commanded
STALLED = 0.2, 1.5  # m/s2, or so little acceleration where so much was asked for
RESPITE = 2.0  # s without a correction: the next one is a new one
HARD = 3.5  # m/s2: harder braking is an emergency's
LOOKS = 0.4  # s between looks at right of way
ENTERS = 1.0  # s before a line: so near to it no lane change is begun
SERVES = 60.0, 100.0  # m that a lane must serve the route at least, and more for every lane to change back


class Lawful(Commander):
    """Drives every commanded AV of preset `lawful`."""

    controlled: dict[str, Car]  # type: ignore[assignment]  # `_take_over` makes all of them

    def __init__(self, step: float, road: RoadMap, courtesy: float = 1.0) -> None:
        super().__init__(Preset.LAWFUL, step)
        fleet, self._eyes = self.controlled, Eyes(road)
        self._waves, inside = Waves(), Inside(road, self._eyes)
        self._driver = Driver(step, courtesy)
        self._follower = Follower(fleet, self._driver, self._eyes, step)
        self._crossing = Crossing(fleet, self._driver, road, self._eyes, inside, step)
        self._way = Way(inside, self._waves, step)
        self._wish = Wish(step)
        # the follower first: whether there must be room decides what else counts
        first = self._follower, self._wish, self._driver
        leader = Leader(self._eyes, self._waves, step)
        self._rules: tuple[Rule, ...] = *first, leader, self._crossing, self._way
        self._looked = -math.inf  # s
        self._begun: list[Intervention] = []

    def drive(self) -> None:
        """Before every simulation step: what the strictest rule says."""
        now = sumo.simulation.getTime()
        self._look(now)
        self._follower.begin()
        for car in self.controlled.values():
            made_room = car.makes_room
            least = min(rule.limit(car) for rule in self._rules)
            if car.makes_room and not made_room:
                self._begun.append(Intervention(now, car.name, "emergency: vehicle behind"))
            self._driver.drive(car, least)

    def see(self, snapshot: Snapshot) -> None:
        """A new frame, with what every AV knows of it."""
        self._eyes.open(snapshot)
        if not self._eyes.ideal:
            for name in self.controlled:
                self._blind(name)

    def observe(self, now: float) -> list[Intervention]:
        """After every simulation step, at `now` (s): where the car began to drive otherwise than asked."""
        get, begun = sumo.vehicle, self._begun
        self._begun = []
        for name, car in self.controlled.items():
            accel = (get.getSpeed(name) - car.speed) / self._step
            if accel < min(car.raw, 0.0) - CORRECTED or (car.raw > STALLED[1] and accel < STALLED[0]):
                if now - car.corrected > RESPITE:
                    begun.append(Intervention(now, name, self._reason(car, accel)))
                car.corrected = now
            lateral = get.getLateralLanePosition(name)
            drift, car.lateral = lateral - car.lateral, lateral
            if 0.05 < abs(drift) < 1.0 and not car.changing(now):  # SUMO changes lanes for the route
                self._changes(name, car, 1 if drift > 0.0 else -1, now)
        return begun

    def heads_for(self, name: str) -> float | None:
        """SUMO's driver heads for the limit."""
        return float(sumo.vehicle.getAllowedSpeed(name))

    def drop(self, name: str) -> None:
        """Also of one that crashed."""
        super().drop(name)
        self._forget(name)
        self._waves.forget(name)

    # ---- inside ----

    def _look(self, now: float) -> None:
        """Where every AV is; from time to time, who gives way."""
        for car in self.controlled.values():
            car.look(now)
        if now - self._looked > LOOKS - 1e-6:
            self._looked = now
            for car in self.controlled.values():
                self._crossing.look(car, LOOKS)

    def _reason(self, car: Car, accel: float) -> str:
        """Of the smallest limit; where it was the agent's, SUMO's driver was slower still."""
        limit: Limit = car.driven
        words = limit.reason if limit.reason not in ("", LAW) else self._driver.reason(car)
        return f"emergency: {words}" if accel < -HARD else words

    def _take_over(self, name: str) -> Car:
        get = sumo.vehicle
        self._driver.take_over(name)
        self._blind(name)
        get.setSpeedFactor(name, min(get.getSpeedFactor(name), 1.0))
        return Car(0.0, name=name, speed=get.getSpeed(name), lateral=get.getLateralLanePosition(name))

    def _hand_back(self, name: str) -> None:
        self._waves.blind(name, ())
        self._waves.ignore(name, ())
        self._driver.hand_back(name)
        self._forget(name)

    def _forget(self, name: str) -> None:
        for rule in self._rules:
            rule.drop(name)

    def _blind(self, name: str) -> None:
        """SUMO's driver heeds no vehicle that the AV does not know of."""
        self._waves.blind(name, self._eyes.unseen(name))

    def _forbidden(self, name: str, lane: str, offset: int) -> str | None:
        why = super()._forbidden(name, lane, offset)
        if why is None:
            why = _at_junction(name, lane)
        if why is None:
            why = _leaves_route(name, lane, offset)
            if why is not None:
                self._begun.append(Intervention(sumo.simulation.getTime(), name, why))
        return why


def _at_junction(name: str, lane: str) -> str | None:
    """Why a vehicle on `lane` is too near to a junction to change lanes; None if it is not.

    SUMO draws whoever changes lanes along the lane, and so turns at once a rear that still stands in a
    junction: a bus into those beside it. And a change that is asked for before a line may begin behind it.
    """
    get = sumo.vehicle
    place = get.getLanePosition(name)
    if place < get.getLength(name):
        return "still leaving a junction"
    if sumo.lane.getLength(lane) - place < get.getSpeed(name) * ENTERS:
        return "about to enter a junction"
    return None


def _leaves_route(name: str, lane: str, offset: int) -> str | None:
    """Why the lane at `offset` does not serve the route long enough to change to it; None if it does."""
    best = sumo.vehicle.getBestLanes(name)
    here = int(lane.rpartition("_")[2])
    if not 0 <= here + offset < len(best):
        return None
    now, then = best[here], best[here + offset]
    at = sumo.vehicle.getLanePosition(name)
    least, more = SERVES
    away = abs(then[3])
    if away <= abs(now[3]) or then[1] - at > least + more * away:
        return None
    return "the lane leaves the route"
