"""Driver errors between junctions: inattention, braking and stopping for no reason, cut-ins."""

from cosim.control import LANE_CHANGE_TIME
from cosim.simulation.backend import sumo
from cosim.simulation.driver_errors.kind import BLIND, MIN_SPEED, Chance, DriverError, UnderWay
from cosim.simulation.driver_errors.surroundings import follower, leader
from cosim.simulation.mobil import LEFT, RIGHT, route_allows


class Inattention(DriverError):
    """The driver keeps speed and lane and sees no other vehicle."""

    name = "inattention"
    every_second = True

    def eligible(self, driver: str, now: float) -> Chance | None:
        """While the vehicle moves behind a leader."""
        ahead = leader(driver)
        return Chance(ahead) if ahead and self._around.speed_of(driver) >= MIN_SPEED else None

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """The driver holds the present speed."""
        length = self.magnitude(self.config.duration, driver, now, "duration")
        under_way = self.begun(driver, now, length, f"sees nobody for {length:.1f} s", chance.other)
        self.take(driver, under_way, BLIND)
        under_way.deceleration = 0.0
        self.brake_once(driver, 0.0)
        return under_way


class HardBraking(DriverError):
    """The driver brakes for no reason."""

    name = "hard_braking"
    every_second = True

    def eligible(self, driver: str, now: float) -> Chance | None:
        """While the vehicle moves."""
        return None if self._around.speed_of(driver) < MIN_SPEED else Chance(follower(driver))

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """The driver brakes."""
        decel = self.magnitude(self.config.deceleration, driver, now, "deceleration")
        length = self.magnitude(self.config.duration, driver, now, "duration")
        what = f"brakes with {decel:.1f} m/s2 for {length:.1f} s for no reason"
        return self.brake(driver, self.begun(driver, now, length, what, chance.other), decel)


class StalledCar(DriverError):
    """The driver stops in the lane and stays there."""

    name = "stalled_car"
    every_second = True

    def eligible(self, driver: str, now: float) -> Chance | None:
        """While the vehicle moves outside junctions."""
        if self._around.speed_of(driver) < MIN_SPEED or self._around.lane_of(driver).startswith(":"):
            return None
        return Chance(follower(driver))

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """The driver brakes to a standstill."""
        decel = self.magnitude(self.config.deceleration, driver, now, "deceleration")
        standstill = self.magnitude(self.config.duration, driver, now, "duration")
        length = self._around.speed_of(driver) / decel + standstill
        return self.brake(driver, self.begun(driver, now, length, "stops in its lane", chance.other), decel)


class CutIn(DriverError):
    """The driver changes lanes although the new follower must brake hard."""

    name = "cut_in"
    every_second = True
    changes = 1  # lane changes; 2: there and back

    def eligible(self, driver: str, now: float) -> Chance | None:
        """Where an adjacent gap asks the new follower for a deceleration in `config.deceleration`."""
        low, high = self.config.deceleration
        around, lane = self._around, self._around.lane_of(driver)
        if around.speed_of(driver) < MIN_SPEED or around.changing(driver) or not lane or lane[0] == ":":
            return None
        found = []
        for side in (LEFT, RIGHT):
            gap = around.adjacent_gap(driver, lane, side)
            if gap is not None and low <= gap.drac <= high and route_allows(driver, side):
                found.append((gap, side))
        return Chance(min(found)[0].vehicle, min(found)) if found else None

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """The lane change begins."""
        (decel, _, behind), side = chance.found
        back = self.changes == 2
        what = f"cuts in before {behind}, who must brake with {decel:.1f} m/s2" + ", and swerves back" * back
        under_way = self.begun(driver, now, self.changes * LANE_CHANGE_TIME + self._step, what, behind)
        self.take(driver, under_way, None)
        if back:
            under_way.swerve_back = now + LANE_CHANGE_TIME, -side
        sumo.vehicle.changeLaneRelative(driver, side, LANE_CHANGE_TIME)
        return under_way


class AbortedCutIn(CutIn):
    """A cut-in after which the driver swerves back at once."""

    name = "aborted_cut_in"
    changes = 2

    def step(self, driver: str, under_way: UnderWay, now: float) -> bool:
        """The driver swerves back after the first lane change."""
        if super().step(driver, under_way, now):
            return True
        if under_way.swerve_back is not None and now >= under_way.swerve_back[0] - 1e-6:
            sumo.vehicle.changeLaneRelative(driver, under_way.swerve_back[1], LANE_CHANGE_TIME)
            under_way.swerve_back = None
        return False
