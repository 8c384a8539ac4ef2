"""Errors at lines, signals and ends of lanes, and of persons at crossings."""

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

MAX_QUEUE_SPEED = 3.0  # m/s, of a driver who waits at a line
WAITING_ZONE = 15.0  # m before the line within which it waits
APPROACH = 30.0  # m before the line within which it looks for the right of way
SIGNAL_RANGE = 150.0  # m before the line
FORCED_CHANGE_TIME = 4.0  # s that a forced lane change may take
# what a person who steps out has, and what holds where its type does not say
STEP_OUT_PARAMETERS = {
    "jmDriveAfterRedTime": ("1000", "-1"),
    "jmIgnoreFoeProb": ("1", "0"),
    "jmIgnoreFoeSpeed": ("100", "0"),
}


class FailureToYield(DriverError):
    """It does not see the vehicles with the right of way."""

    name = "failure_to_yield"

    def trial(self, who: str, place: Place, now: float) -> Trial | None:
        """One of every approach to a line where it must give way."""
        looks = place.gives_way and place.to_line < APPROACH and self._around.yields(who)
        return Trial(self.config.rate, place.edge, True) if looks else None

    def eligible(self, who: str, now: float) -> Chance | None:
        """Always."""
        met = self._around.foes(who)
        return Chance(met[0].whom if met else "")

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """It drives on."""
        whom = chance.whom
        what = f"does not see {whom}, who has the right of way" if whom else "does not look who comes"
        return self.drives_on(who, now, RIGHT_OF_WAY, what, whom)


class RedLight(DriverError):
    """It does not stop for a signal that turns red before it is there."""

    name = "red_light"
    meets_anybody = True

    def trial(self, who: str, place: Place, now: float) -> Trial | None:
        """One of every yellow light that is red when it arrives, late by as much as the kind says."""
        if not place.signal or place.to_line >= SIGNAL_RANGE:
            return None
        ahead = sumo.vehicle.getNextTLS(who)
        if not ahead or ahead[0][3] not in "yY":
            return None
        light, _, away, _ = ahead[0]
        red = sumo.trafficlight.getNextSwitch(light)
        arrives = now + away / max(self._around.speed_of(who), 0.1)
        late = red < arrives <= red + self.config.late
        return Trial(self.config.rate, f"{place.edge}/{red:.1f}", True) if late else None

    def eligible(self, who: str, now: float) -> Chance | None:
        """Always."""
        return Chance("")

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """It drives on."""
        return self.drives_on(who, now, RIGHT_OF_WAY | RED_LIGHT, "does not stop for red", "")


class ForcedEntry(DriverError):
    """It enters though it must wait: the likelier the longer it has waited."""

    name = "forced_entry"

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._waited: dict[str, int] = {}  # vehicle -> s that it has waited for a gap

    def trial(self, who: str, place: Place, now: float) -> Trial | None:
        """One of every second in which it waits at a line or near the end of its lane."""
        at_line = place.gives_way and place.to_line < WAITING_ZONE
        slow = at_line and self._around.speed_of(who) < MAX_QUEUE_SPEED
        if not (slow and self._around.yields(who)) and not self._at_end_of_lane(who, place.lane):
            self.forget(who)
            return None
        waited = self._waited[who] = self._waited.get(who, 0) + 1
        return Trial(hazard(self.config, waited), f"{round(now)}", False)

    def forget(self, who: str) -> None:
        """It waits no longer."""
        self._waited.pop(who, None)

    def eligible(self, who: str, now: float) -> Chance | None:
        """Where no vehicle would be there too soon."""
        lane, refuses = self._around.lane_of(who), self.config.lag
        if self._at_end_of_lane(who, lane):
            side, _ = self._around.needed_change(who, lane)
            beside = None if self._around.changing(who) else self._around.beside(who, lane, side)
            return None if beside is None or beside.lag < refuses else Chance(beside.whom, (beside, side))
        met = self._around.foes(who)
        if not met or any(foe.lag < refuses for foe in met):
            return None
        return Chance(met[0].whom, (met[0], 0))

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """It changes lanes, or drives on."""
        gap, side = chance.found
        what = _forces(self._waited[who], gap)
        if not side:
            return self.drives_on(who, now, RIGHT_OF_WAY, what, gap.whom)
        under_way = self.begun(who, now, FORCED_CHANGE_TIME, what, gap.whom)
        self.take(who, under_way, None)
        sumo.vehicle.changeLaneRelative(who, side, FORCED_CHANGE_TIME)
        return under_way

    def _at_end_of_lane(self, who: str, lane: str) -> bool:
        around = self._around
        return around.needed_change(who, lane)[0] != 0 and around.left(who, lane) < self.config.zone


class StepOut(ErrorKind):
    """A person walks onto the crossing without waiting."""

    name = "step_out"
    meets_anybody = True

    def eligible(self, who: str, now: float) -> Chance | None:
        """Always."""
        return Chance("")

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """It walks, whatever comes."""
        person = who.removeprefix(PERSON)
        length = self.magnitude(self.config.duration, who, now, "duration")
        under_way = self.begun(who, now, length, "walks onto the crossing without waiting", "")
        sumo.person.setMinGap(person, sumo.person.getMinGap(person))  # a type of its own
        under_way.heeds = _crosses_by(person, {name: on for name, (on, _) in STEP_OUT_PARAMETERS.items()})
        return under_way

    def end(self, who: str, under_way: UnderWay) -> None:
        """It waits as before."""
        person = who.removeprefix(PERSON)
        if under_way.heeds is not None and person in sumo.person.getIDList():
            _crosses_by(person, under_way.heeds)


def hazard(config: human_errors.ForcedEntry, waited: int) -> float:
    """The probability that a driver who has waited so many s forces its way in in the next one."""
    return min(config.rate * max(waited - config.patience, 0.0), 1.0)


def _forces(waited: int, gap: Gap) -> str:
    whom = f"{gap.whom} must brake with {gap.asked:.1f} m/s2" if gap.whom else "nobody comes"
    return f"forces its way in after {waited} s; {whom}"


def _crosses_by(person: str, values: Mapping[str, str]) -> dict[str, str]:
    """Set what a person heeds at crossings, parameters of its own type; returns them as they were."""
    kind, before = sumo.person.getTypeID(person), {}
    for name, value in values.items():
        full = f"junctionModel.{name}"
        before[name] = sumo.vehicletype.getParameter(kind, full) or STEP_OUT_PARAMETERS[name][1]
        sumo.vehicletype.setParameter(kind, full, value)
    return before
