"""Driver errors at stop lines, signals and lane ends, and errors of pedestrians at crossings."""

from collections.abc import Mapping
from typing import Any

from cosim.scenario import human_errors
from cosim.simulation.backend import sumo
from cosim.simulation.convert import PERSON
from cosim.simulation.driver_errors.kind import (
    RED_LIGHT,
    RIGHT_OF_WAY,
    Chance,
    DriverError,
    ErrorKind,
    Trial,
    UnderWay,
)
from cosim.simulation.driver_errors.surroundings import Gap, Place

MAX_QUEUE_SPEED = 3.0  # m/s, of a driver waiting at a stop line
WAITING_ZONE = 15.0  # m before the stop line, in which a slow vehicle counts as waiting
YIELD_CHECK_DISTANCE = 30.0  # m before the stop line, from which the driver checks for foes
SIGNAL_RANGE = 150.0  # m before the stop line
FORCED_CHANGE_TIME = 4.0  # s that a forced lane change may take
# junction model of a pedestrian stepping out, and the value of a type without this parameter
STEP_OUT_PARAMETERS = {
    "jmDriveAfterRedTime": ("1000", "-1"),
    "jmIgnoreFoeProb": ("1", "0"),
    "jmIgnoreFoeSpeed": ("100", "0"),
}


class FailureToYield(DriverError):
    """The driver overlooks the vehicles with the right of way."""

    name = "failure_to_yield"

    def trial(self, driver: str, place: Place, now: float) -> Trial | None:
        """One trial per approach to a stop line where the driver must yield."""
        checks = place.gives_way and place.to_line < YIELD_CHECK_DISTANCE and self._around.must_yield(driver)
        return Trial(self.config.rate, place.edge, True) if checks else None

    def eligible(self, driver: str, now: float) -> Chance | None:
        """Always."""
        foes = self._around.foes(driver)
        return Chance(foes[0].vehicle if foes else "")

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """The driver enters the junction without yielding."""
        foe = chance.other
        what = f"does not see {foe}, who has the right of way" if foe else "does not look who comes"
        return self.drive_through(driver, now, RIGHT_OF_WAY, what, foe)


class RedLight(DriverError):
    """The driver runs a signal that turns red before the vehicle arrives."""

    name = "red_light"
    other_unknown = True

    def trial(self, driver: str, place: Place, now: float) -> Trial | None:
        """One trial per yellow signal that turns red at most `config.late` s before the arrival."""
        if not place.signal or place.to_line >= SIGNAL_RANGE:
            return None
        ahead = sumo.vehicle.getNextTLS(driver)
        if not ahead or ahead[0][3] not in "yY":
            return None
        light, _, away, _ = ahead[0]
        red = sumo.trafficlight.getNextSwitch(light)
        arrives = now + away / max(self._around.speed_of(driver), 0.1)
        late = red < arrives <= red + self.config.late
        return Trial(self.config.rate, f"{place.edge}/{red:.1f}", True) if late else None

    def eligible(self, driver: str, now: float) -> Chance | None:
        """Always."""
        return Chance("")

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """The driver enters on red."""
        return self.drive_through(driver, now, RIGHT_OF_WAY | RED_LIGHT, "does not stop for red", "")


class ForcedEntry(DriverError):
    """The driver enters a gap that is too short: the probability grows with the waiting time."""

    name = "forced_entry"

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._waited: dict[str, int] = {}  # vehicle -> s of waiting for a gap

    def trial(self, driver: str, place: Place, now: float) -> Trial | None:
        """One trial per second of waiting at a stop line or near the end of the lane."""
        at_line = place.gives_way and place.to_line < WAITING_ZONE
        slow = at_line and self._around.speed_of(driver) < MAX_QUEUE_SPEED
        if not (slow and self._around.must_yield(driver)) and not self._at_end_of_lane(driver, place.lane):
            self.forget(driver)
            return None
        waited = self._waited[driver] = self._waited.get(driver, 0) + 1
        return Trial(hazard(self.config, waited), f"{round(now)}", False)

    def forget(self, driver: str) -> None:
        """The driver no longer waits."""
        self._waited.pop(driver, None)

    def eligible(self, driver: str, now: float) -> Chance | None:
        """Where every conflicting vehicle is at least `config.lag` s away."""
        lane, min_lag = self._around.lane_of(driver), self.config.lag
        if self._at_end_of_lane(driver, lane):
            side, _ = self._around.needed_change(driver, lane)
            gap = None if self._around.changing(driver) else self._around.adjacent_gap(driver, lane, side)
            return None if gap is None or gap.lag < min_lag else Chance(gap.vehicle, (gap, side))
        foes = self._around.foes(driver)
        if not foes or any(foe.lag < min_lag for foe in foes):
            return None
        return Chance(foes[0].vehicle, (foes[0], 0))

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """The driver changes lanes, or enters the junction."""
        gap, side = chance.found
        what = _description(self._waited[driver], gap)
        if not side:
            return self.drive_through(driver, now, RIGHT_OF_WAY, what, gap.vehicle)
        under_way = self.begun(driver, now, FORCED_CHANGE_TIME, what, gap.vehicle)
        self.take(driver, under_way, None)
        sumo.vehicle.changeLaneRelative(driver, side, FORCED_CHANGE_TIME)
        return under_way

    def _at_end_of_lane(self, driver: str, lane: str) -> bool:
        around = self._around
        return around.needed_change(driver, lane)[0] != 0 and around.left(driver, lane) < self.config.zone


class StepOut(ErrorKind):
    """A person walks onto the crossing without waiting."""

    name = "step_out"
    other_unknown = True

    def eligible(self, driver: str, now: float) -> Chance | None:
        """Always."""
        return Chance("")

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """The person walks regardless of vehicles and signals. `driver`: `PERSON` and the person's id."""
        person = driver.removeprefix(PERSON)
        length = self.magnitude(self.config.duration, driver, now, "duration")
        under_way = self.begun(driver, now, length, "walks onto the crossing without waiting", "")
        sumo.person.setMinGap(person, sumo.person.getMinGap(person))  # gives the person its own vType
        under_way.before = _set_crossing(person, {name: on for name, (on, _) in STEP_OUT_PARAMETERS.items()})
        return under_way

    def end(self, driver: str, under_way: UnderWay) -> None:
        """The person waits at crossings as before."""
        person = driver.removeprefix(PERSON)
        if under_way.before is not None and person in sumo.person.getIDList():
            _set_crossing(person, under_way.before)


def hazard(config: human_errors.ForcedEntry, waited: int) -> float:
    """The probability of a forced entry in the next second, after `waited` s."""
    return min(config.rate * max(waited - config.patience, 0.0), 1.0)


def _description(waited: int, gap: Gap) -> str:
    effect = f"{gap.vehicle} must brake with {gap.drac:.1f} m/s2" if gap.vehicle else "nobody comes"
    return f"forces its way in after {waited} s; {effect}"


def _set_crossing(person: str, values: Mapping[str, str]) -> dict[str, str]:
    """Set junction-model parameters of the person's own vType; return their former values."""
    kind, before = sumo.person.getTypeID(person), {}
    for name, value in values.items():
        full = f"junctionModel.{name}"
        before[name] = sumo.vehicletype.getParameter(kind, full) or STEP_OUT_PARAMETERS[name][1]
        sumo.vehicletype.setParameter(kind, full, value)
    return before
