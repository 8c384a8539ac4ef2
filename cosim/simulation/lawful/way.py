"""Vehicles that stand in the AV's way inside a junction: it passes them within its lane, or stops for them.

Before its line, as long as it can stop there, else before their way out of the junction. One that stands
inside stays there while somebody is in its way, or for at most `PATIENCE` may soon be. So that nobody waits
for ever, the AV that has stopped waves the vehicle in its way through.
"""

import math
from collections.abc import Set

from cosim.control import COMFORT
from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.lawful.car import FREE, Car, Limit, Rule
from cosim.simulation.lawful.inside import CLEAR, SWERVES, Ahead, Inside
from cosim.simulation.lawful.waves import NOBODY, Waves
from cosim.simulation.lawful.wish import KEEPS_MOVING, PATIENCE

STANDS = 0.1  # m/s: who is slower inside a junction stands, and looks whether somebody is in its way
STOPS_FOR = 2.5, 1.0  # m/s2, and m that are left, before who stands inside
LOOKS_IN = 25.0  # m before a line: from there on it looks who stands behind it


class Way(Rule):
    """Limits the acceleration before those who stand in the way; `step`: s of a simulation step."""

    def __init__(self, inside: Inside, waves: Waves, step: float) -> None:
        self._inside, self._waves, self._step = inside, waves, step
        self._held: dict[str, float] = {}  # AV -> s, for which it has stayed in, or before, this junction
        self._side: dict[str, float] = {}  # AV -> m to the left of its lane's centre, where it drives

    def limit(self, car: Car) -> Limit:
        """A stop, where it must stop now."""
        waved, held = self._waves.of(car.name), self._held.get(car.name, 0.0)
        stands = car.speed < STANDS
        if car.inside and stands:
            ahead = self._inside.blocked(car.name, car.lane, held >= PATIENCE, waved)
            stays = car.holds or ahead.room < math.inf
        else:
            brakes, left = STOPS_FOR
            needs = car.speed * car.speed / (2.0 * brakes) + left  # m
            ahead, line = self._ahead(car, waved)
            stays = ahead.room < needs or (ahead.room < math.inf and needs - left < line < needs)
        if stays:
            self._held[car.name] = held + self._step
        elif not car.inside and car.speed >= KEEPS_MOVING:
            self._held[car.name] = 0.0
        self._wave(car, ahead.standing if stays and stands else (), waved if stays and stands else NOBODY)
        self._move_aside(car, ahead.side)
        return Limit(-COMFORT, "vehicle in the way") if stays else FREE

    def drop(self, name: str) -> None:
        """It is commanded no more."""
        self._waves.set(name, NOBODY)
        self._held.pop(name, None)
        self._side.pop(name, None)

    # ---- inside ----

    def _ahead(self, car: Car, waved: Set[str]) -> tuple[Ahead, float]:
        """Its way through the junction that it is in, or comes to; m to its line, or inf."""
        if car.inside:
            return self._inside.room(car.name, car.lane, waved), math.inf
        links = sumo.vehicle.getNextLinks(car.name) if car.left < LOOKS_IN else ()
        if not links or not links[0][4] or links[0][5] in RED + YELLOW:
            return CLEAR, car.left
        ahead = self._inside.room(car.name, links[0][4], waved, 0.0, car.left)
        return ahead._replace(room=car.left + ahead.room), car.left

    def _wave(self, car: Car, standing: tuple[str, ...], waved: Set[str]) -> None:
        """Let those go first who can get out past it, as long as they are inside."""
        waves = {one for one in standing if one in waved or self._inside.can_pass(one, car.name)}
        waves |= {one for one in waved if self._inside.inside(one)}
        self._waves.set(car.name, waves, self._inside.behind(car.name, car.lane) if waves else NOBODY)

    def _move_aside(self, car: Car, wanted: float) -> None:
        """Drive so many m to the left of the lane's centre, reached by and by."""
        side = self._side.get(car.name, 0.0)
        if wanted == side or car.changing(car.now):
            return
        most = SWERVES * car.speed * self._step
        moved = min(max(wanted - side, -most), most)
        if moved:
            self._side[car.name] = side + moved
            car.lateral += moved  # it is no change of lanes
            sumo.vehicle.setLateralLanePosition(car.name, side + moved)
