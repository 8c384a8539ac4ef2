"""The car of preset `lawful`: the agent's wish, limited by SUMO's own driver and by seven more rules.

Before every simulation step each rule limits the acceleration of the AV and names a reason. The AV drives the
smallest limit, and an intervention is reported with its reason:

- `wish`: the agent's request, driven comfortably;
- `driver`: SUMO's driver (speed mode 31): signals, right of way, speed limits, persons. Where its limit is
  the smallest, SUMO's driver drives by itself and may brake as hard as necessary;
- `leader`: car following, and early braking for vehicles beyond the leader;
- `lane end`: room for the vehicle beside the AV where a lane ends that the AV must leave;
- `follower`: room for a human follower that does not brake;
- `signal`: signals that have turned yellow;
- `crossing`: stop lines at which the AV gives way;
- `way`: vehicles that block the AV's way inside a junction.
"""

import math
from collections.abc import Callable

from cosim.road import RoadMap
from cosim.simulation.backend import sumo
from cosim.simulation.commands import Commander
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import LAW, Car, Limit, Rule
from cosim.simulation.lawful.crossing import Crossing
from cosim.simulation.lawful.driver import Driver
from cosim.simulation.lawful.follower import Follower
from cosim.simulation.lawful.inside import Inside
from cosim.simulation.lawful.lane_end import LaneEnd
from cosim.simulation.lawful.leader import Leader
from cosim.simulation.lawful.signal import Signal
from cosim.simulation.lawful.waves import Waves
from cosim.simulation.lawful.way import Way
from cosim.simulation.lawful.wish import Wish
from cosim.types import Intervention, Preset, Snapshot

CORRECTION = 1.0  # m/s2: braking this much harder than the agent asked counts as an intervention
STALL = 0.2, 1.5  # m/s2: so does less than the first, if the agent asked for more than the second
MIN_CORRECTION_INTERVAL = 2.0  # s: two corrections closer together count as one intervention
EMERGENCY_DECEL = 3.5  # m/s2: harder braking is reported as an emergency
RIGHT_OF_WAY_PERIOD = 0.4  # s between two checks of the right of way
JUNCTION_LEAD_TIME = 1.0  # s before the stop line, from which no lane change begins
MIN_ROUTE_LENGTHS = 60.0, 100.0  # m that a lane must serve the route, and m more for each lane change back


class Lawful(Commander):
    """Drives every commanded AV in preset `lawful`."""

    controlled: dict[str, Car]  # type: ignore[assignment]  # `_take_control` makes every entry

    def __init__(self, step: float, road: RoadMap, courteous: Callable[[str], bool]) -> None:
        super().__init__(Preset.LAWFUL, step)
        fleet, self._eyes = self.controlled, Eyes(road)
        self._waves, inside = Waves(), Inside(road, self._eyes)
        self._driver = Driver(step, courteous)
        self._follower = Follower(fleet, self._driver, self._eyes, step)
        self._crossing = Crossing(fleet, self._driver, road, self._eyes, inside, step)
        self._way = Way(inside, self._waves, step)
        self._wish = Wish(step)
        # The follower rule comes first: an evasion changes the limits of the other rules.
        before_leader = self._follower, self._wish, self._driver
        leader = Leader(self._eyes, self._waves, step)
        lane_end, signal = LaneEnd(self._driver, self._eyes, step), Signal(road, step)
        self._rules: tuple[Rule, ...] = *before_leader, leader, lane_end, signal, self._crossing, self._way
        self._last_check = -math.inf  # s, the last check of the right of way
        self._interventions: list[Intervention] = []

    def drive(self) -> None:
        """Apply the strictest rule to every AV; called before every simulation step."""
        now = sumo.simulation.getTime()
        self._update_cars(now)
        self._follower.begin_step()
        for car in self.controlled.values():
            was_evading = car.evading
            strictest = min(rule.limit(car) for rule in self._rules)
            if car.evading and not was_evading:
                self._interventions.append(Intervention(now, car.name, "emergency: vehicle behind"))
            self._driver.drive(car, strictest)

    def update_percepts(self, snapshot: Snapshot) -> None:
        """Take a new frame, with the percept of every AV."""
        self._eyes.update(snapshot)
        if not self._eyes.ideal:
            for name in self.controlled:
                self._hide_unknown(name)

    def find_interventions(self, now: float) -> list[Intervention]:
        """The interventions that began in the step that ended at `now` (s)."""
        get, found = sumo.vehicle, self._interventions
        self._interventions = []
        for name, car in self.controlled.items():
            accel = (get.getSpeed(name) - car.speed) / self._step
            if accel < min(car.wished, 0.0) - CORRECTION or (car.wished > STALL[1] and accel < STALL[0]):
                if now - car.last_correction > MIN_CORRECTION_INTERVAL:
                    found.append(Intervention(now, name, self._reason(car, accel)))
                car.last_correction = now
            lateral = get.getLateralLanePosition(name)
            drift, car.lateral_offset = lateral - car.lateral_offset, lateral
            if 0.05 < abs(drift) < 1.0 and not car.changing(now):  # a lane change by SUMO
                self._record_lane_change(name, car, 1 if drift > 0.0 else -1, now)
        return found

    def default_target_speed(self, name: str) -> float | None:
        """The speed limit, for which SUMO's driver aims."""
        return float(sumo.vehicle.getAllowedSpeed(name))

    def drop(self, name: str) -> None:
        """The AV has left the road or has crashed."""
        super().drop(name)
        self._forget(name)
        self._waves.forget(name)

    # ---- inside ----

    def _update_cars(self, now: float) -> None:
        """Read the state of every AV; at intervals, also check the right of way."""
        for car in self.controlled.values():
            car.update(now)
        if now - self._last_check > RIGHT_OF_WAY_PERIOD - 1e-6:
            self._last_check = now
            for car in self.controlled.values():
                self._crossing.update(car, RIGHT_OF_WAY_PERIOD)

    def _reason(self, car: Car, accel: float) -> str:
        """The reason of the smallest limit; that of SUMO's driver if the limit was the agent's wish."""
        limit: Limit = car.last_limit
        words = limit.reason if limit.reason not in ("", LAW) else self._driver.reason(car)
        return f"emergency: {words}" if accel < -EMERGENCY_DECEL else words

    def _take_control(self, name: str) -> Car:
        get = sumo.vehicle
        self._driver.take_control(name)
        self._hide_unknown(name)
        get.setSpeedFactor(name, min(get.getSpeedFactor(name), 1.0))
        return Car(0.0, name=name, speed=get.getSpeed(name), lateral_offset=get.getLateralLanePosition(name))

    def _release_control(self, name: str) -> None:
        self._waves.hide(name, ())
        self._waves.ignore_leaders(name, ())
        self._driver.release_control(name)
        self._forget(name)

    def _forget(self, name: str) -> None:
        for rule in self._rules:
            rule.drop(name)

    def _hide_unknown(self, name: str) -> None:
        """Make SUMO's driver ignore the vehicles that the AV does not know of."""
        self._waves.hide(name, self._eyes.unknown(name))

    def _refusal(self, name: str, lane: str, offset: int) -> str | None:
        refusal = super()._refusal(name, lane, offset)
        if refusal is None:
            refusal = _junction_refusal(name, lane)
        if refusal is None:
            refusal = _route_refusal(name, lane, offset)
            if refusal is not None:
                self._interventions.append(Intervention(sumo.simulation.getTime(), name, refusal))
        return refusal


def _junction_refusal(name: str, lane: str) -> str | None:
    """Why a vehicle on `lane` is too close to a junction to change lanes; None if it is not.

    SUMO aligns a changing vehicle with its lane at once. The rear of a bus that is still inside the junction
    then swings into neighbouring vehicles. A change requested before a stop line may begin beyond the line.
    """
    get = sumo.vehicle
    position = get.getLanePosition(name)
    if position < get.getLength(name):
        return "still leaving a junction"
    if sumo.lane.getLength(lane) - position < get.getSpeed(name) * JUNCTION_LEAD_TIME:
        return "about to enter a junction"
    return None


def _route_refusal(name: str, lane: str, offset: int) -> str | None:
    """Why the lane at `offset` serves the route for too short a distance; None if it is long enough."""
    best = sumo.vehicle.getBestLanes(name)
    here = int(lane.rpartition("_")[2])
    if not 0 <= here + offset < len(best):
        return None
    now, then = best[here], best[here + offset]
    at = sumo.vehicle.getLanePosition(name)
    least, more = MIN_ROUTE_LENGTHS
    away = abs(then[3])
    if away <= abs(now[3]) or then[1] - at > least + more * away:
        return None
    return "the lane leaves the route"
