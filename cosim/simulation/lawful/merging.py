"""Between AVs gaps are asked for and given (V2V): SUMO's own cooperation ends where a speed is commanded."""

from collections.abc import Mapping

from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.lawful.car import FREE, Car, Limit, Rule

GAP = 2.0, 1.0  # m and s: the gap given to who changes lanes
STOOD = 1.0  # m more of it for who has stood for `PATIENCE` and cannot change lanes
YIELDING = 2.0, 1.0  # m/s2 and m/s: how hard, and down to what, an AV slows for who asked
PATIENCE = 10.0  # s
BEHIND = 60.0  # m
STANDS, MOVES = 0.1, 3.0  # m/s
STRATEGIC, BLOCKED = 8, 512 + 1024 + 2048 + 4096 + 8192  # bits of SUMO's lane-change state


class Merging(Rule):
    """Limits the acceleration of an AV that was asked for a gap; `step`: s of a simulation step."""

    def __init__(self, fleet: Mapping[str, Car], eyes: Eyes, step: float) -> None:
        self._fleet, self._eyes, self._step = fleet, eyes, step
        self._stood: dict[str, float] = {}  # AV -> s, for which it has stood while somebody asked for a gap

    def ask(self) -> None:
        """Every AV that must change lanes and cannot asks the AV behind its gap to make room."""
        get = sumo.vehicle
        for car in self._fleet.values():
            car.gap_for = ""
        for name in [name for name, car in self._fleet.items() if car.lane]:
            for side in (1, -1):
                wanted = get.getLaneChangeState(name, side)[0]
                if wanted & STRATEGIC and wanted & BLOCKED:
                    # of two that block one another the one that asks first goes first
                    asked = [other for other, _ in get.getNeighbors(name, 0 if side > 0 else 1)]
                    if get.getWaitingTime(name) > PATIENCE:  # the nearest may always be too near
                        asked += [get.getFollower(other, BEHIND)[0] for other in asked]
                    self._give(asked, name)

    def limit(self, car: Car) -> Limit:
        """What opens the gap that it was asked for."""
        if car.speed >= MOVES:
            self._stood[car.name] = 0.0
        if not car.gap_for or car.makes_room:
            return FREE
        found = self._opens(car)
        self._stood[car.name] = self._stood.get(car.name, 0.0) + self._step * (car.speed < STANDS)
        return found

    def drop(self, name: str) -> None:
        """It is commanded no more."""
        self._stood.pop(name, None)

    # ---- inside ----

    def _give(self, asked: list[str], name: str) -> None:
        for other in asked:
            heard = other in self._fleet and self._eyes.hears(other, name)
            if heard and not self._fleet[name].gap_for:
                self._fleet[other].gap_for = name

    def _opens(self, car: Car) -> Limit:
        seen, asks, (brakes, least) = self._eyes.of(car.name), car.gap_for, YIELDING
        if not self._eyes.known(car.name, [asks]):
            return FREE
        try:
            gap = seen.getLanePosition(asks) - seen.getLength(asks) - seen.getLanePosition(car.name)
            theirs = seen.getSpeed(asks)
        except sumo.TraCIException:  # it has left
            return FREE
        room, headway = GAP
        near = max(car.speed**2 - theirs**2, 0.0) / (2.0 * brakes)  # m
        # the first that can stops for who has stood for long, but not for ever: other things may keep him
        if seen.getWaitingTime(asks) > PATIENCE and self._stood.get(car.name, 0.0) < PATIENCE:
            room, least = room + STOOD, 0.0
            near += room
        if gap < near:
            return FREE  # it is beside, or too near: it goes first, whoever follows it gives way
        slower = max(theirs + 0.5 * (gap - room - headway * car.speed), least)  # m/s
        return Limit(max(slower - car.speed, -brakes), "lets an AV change lanes")
