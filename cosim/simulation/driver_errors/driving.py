"""Errors of a driver on the open road: inattention, braking and stopping for no reason, cut-ins."""

from cosim.control import LANE_CHANGE_TIME
from cosim.simulation.backend import sumo
from cosim.simulation.driver_errors.kind import BLIND, MIN_SPEED, Chance, DriverError, UnderWay
from cosim.simulation.driver_errors.surroundings import follower, leader
from cosim.simulation.mobil import LEFT, RIGHT, route_allows


class Inattention(DriverError):
    """It keeps its speed and its lane and sees nobody."""

    name = "inattention"
    every_second = True

    def eligible(self, who: str, now: float) -> Chance | None:
        """Behind a vehicle, while it drives."""
        ahead = leader(who)
        return Chance(ahead) if ahead and self._around.speed_of(who) >= MIN_SPEED else None

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """It holds its speed."""
        length = self.magnitude(self.config.duration, who, now, "duration")
        under_way = self.begun(who, now, length, f"sees nobody for {length:.1f} s", chance.whom)
        self.take(who, under_way, BLIND)
        under_way.deceleration = 0.0
        self.slow(who, 0.0)
        return under_way


class HardBraking(DriverError):
    """It brakes for no reason."""

    name = "hard_braking"
    every_second = True

    def eligible(self, who: str, now: float) -> Chance | None:
        """While it drives."""
        return None if self._around.speed_of(who) < MIN_SPEED else Chance(follower(who))

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """It brakes."""
        hard = self.magnitude(self.config.deceleration, who, now, "deceleration")
        length = self.magnitude(self.config.duration, who, now, "duration")
        what = f"brakes with {hard:.1f} m/s2 for {length:.1f} s for no reason"
        return self.slows(who, self.begun(who, now, length, what, chance.whom), hard)


class StalledCar(DriverError):
    """It stops in its lane and stands."""

    name = "stalled_car"
    every_second = True

    def eligible(self, who: str, now: float) -> Chance | None:
        """While it drives outside junctions."""
        if self._around.speed_of(who) < MIN_SPEED or self._around.lane_of(who).startswith(":"):
            return None
        return Chance(follower(who))

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """It slows down."""
        slows = self.magnitude(self.config.deceleration, who, now, "deceleration")
        stands = self.magnitude(self.config.duration, who, now, "duration")
        length = self._around.speed_of(who) / slows + stands
        return self.slows(who, self.begun(who, now, length, "stops in its lane", chance.whom), slows)


class CutIn(DriverError):
    """It changes lanes though the new follower must brake hard."""

    name = "cut_in"
    every_second = True
    changes = 1  # and back

    def eligible(self, who: str, now: float) -> Chance | None:
        """Where such a gap is beside it."""
        low, high = self.config.deceleration
        around, lane = self._around, self._around.lane_of(who)
        if around.speed_of(who) < MIN_SPEED or around.changing(who) or not lane or lane[0] == ":":
            return None
        found = []
        for side in (LEFT, RIGHT):
            beside = around.beside(who, lane, side)
            if beside is not None and low <= beside.asked <= high and route_allows(who, side):
                found.append((beside, side))
        return Chance(min(found)[0].whom, min(found)) if found else None

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """The change begins."""
        (asked, _, whom), side = chance.found
        back = self.changes == 2
        what = f"cuts in before {whom}, who must brake with {asked:.1f} m/s2" + ", and swerves back" * back
        under_way = self.begun(who, now, self.changes * LANE_CHANGE_TIME + self._step, what, whom)
        self.take(who, under_way, None)
        if back:
            under_way.swerves = now + LANE_CHANGE_TIME, -side
        sumo.vehicle.changeLaneRelative(who, side, LANE_CHANGE_TIME)
        return under_way


class AbortedCutIn(CutIn):
    """The same, and it swerves back at once."""

    name = "aborted_cut_in"
    changes = 2

    def step(self, who: str, under_way: UnderWay, now: float) -> bool:
        """It swerves back when it has changed."""
        if super().step(who, under_way, now):
            return True
        if under_way.swerves is not None and now >= under_way.swerves[0] - 1e-6:
            sumo.vehicle.changeLaneRelative(who, under_way.swerves[1], LANE_CHANGE_TIME)
            under_way.swerves = None
        return False
