"""Vehicles that block the AV's way inside a junction: the AV passes them within its lane, or stops.

The AV stops before its line if it still can, else before the other vehicle's way out of the junction. Inside,
it stays while a vehicle blocks its way; for vehicles that may soon do so, at most `PATIENCE` s. The stopped
AV waves the blocking vehicle through, so that neither waits for ever.
"""

import math
from collections.abc import Set

from cosim.control import COMFORT_ACCEL
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.lawful.car import NO_LIMIT, Car, Limit, Rule
from cosim.simulation.lawful.inside import CLEAR, SWERVE_RATE, Inside, WayOut
from cosim.simulation.lawful.waves import EMPTY, Waves
from cosim.simulation.lawful.wish import MIN_JUNCTION_SPEED, PATIENCE

STANDING_SPEED = 0.1  # m/s: a slower AV inside a junction checks its way before it sets off
STOPPING_LIMITS = 2.5, 1.0  # m/s2, and m left to a blocking vehicle
JUNCTION_LOOKAHEAD = 25.0  # m before the stop line


class Way(Rule):
    """Limits the acceleration before blocking vehicles; `step`: s of a simulation step."""

    def __init__(self, inside: Inside, waves: Waves, step: float) -> None:
        self._inside, self._waves, self._step = inside, waves, step
        self._stop_time: dict[str, float] = {}  # AV -> s of stopping in, or before, this junction
        self._offset: dict[str, float] = {}  # AV -> m to the left of the lane's centre line

    def limit(self, car: Car) -> Limit:
        """A stop, if the AV must stop now."""
        waved, held = self._waves.waved(car.name), self._stop_time.get(car.name, 0.0)
        stands = car.speed < STANDING_SPEED
        if car.in_junction and stands:
            ahead = self._inside.way_from_standstill(car.name, car.lane, held >= PATIENCE, waved)
            stays = car.held_for_av or ahead.distance < math.inf
        else:
            decel, left = STOPPING_LIMITS
            needed = car.speed * car.speed / (2.0 * decel) + left  # m
            ahead, line = self._way_ahead(car, waved)
            stays = ahead.distance < needed or (ahead.distance < math.inf and needed - left < line < needed)
        if stays:
            self._stop_time[car.name] = held + self._step
        elif not car.in_junction and car.speed >= MIN_JUNCTION_SPEED:
            self._stop_time[car.name] = 0.0
        self._wave(car, ahead.blockers if stays and stands else (), waved if stays and stands else EMPTY)
        self._move_aside(car, ahead.offset)
        return Limit(-COMFORT_ACCEL, "vehicle in the way") if stays else NO_LIMIT

    def drop(self, name: str) -> None:
        """The AV is no longer commanded."""
        self._waves.set(name, EMPTY)
        self._stop_time.pop(name, None)
        self._offset.pop(name, None)

    # ---- inside ----

    def _way_ahead(self, car: Car, waved: Set[str]) -> tuple[WayOut, float]:
        """The AV's way through the present or next junction; m to its line, or inf."""
        if car.in_junction:
            return self._inside.way_ahead(car.name, car.lane, waved), math.inf
        links = sumo.vehicle.getNextLinks(car.name) if car.to_line < JUNCTION_LOOKAHEAD else ()
        if not links or not links[0][4] or links[0][5] in RED + YELLOW:
            return CLEAR, car.to_line
        ahead = self._inside.way_ahead(car.name, links[0][4], waved, 0.0, car.to_line)
        return ahead._replace(distance=car.to_line + ahead.distance), car.to_line

    def _wave(self, car: Car, standing: tuple[str, ...], waved: Set[str]) -> None:
        """Wave the blocking vehicles through that can pass the AV, until they have left the junction."""
        waves = {one for one in standing if one in waved or self._inside.can_pass(one, car.name)}
        waves |= {one for one in waved if self._inside.is_inside(one)}
        self._waves.set(car.name, waves, self._inside.queue_behind(car.name, car.lane) if waves else EMPTY)

    def _move_aside(self, car: Car, wanted: float) -> None:
        """Shift the AV gradually to `wanted` m to the left of the lane's centre line."""
        side = self._offset.get(car.name, 0.0)
        if wanted == side or car.changing(car.now):
            return
        most = SWERVE_RATE * car.speed * self._step
        moved = min(max(wanted - side, -most), most)
        if moved:
            self._offset[car.name] = side + moved
            car.lateral_offset += moved  # not a lane change
            sumo.vehicle.setLateralLanePosition(car.name, side + moved)
