"""SUMO's driver in the AV, which obeys the law: signals, right of way, speed limits, persons.

Where SUMO's driver is slower than every other rule, it drives uncommanded and may brake as hard as necessary.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.commands import SPEED_MODE
from cosim.simulation.derived_types import LATE_TYPE, LAWFUL_TYPE, derive, is_known, own_type, suffix
from cosim.simulation.fleet import set_type
from cosim.simulation.lawful.car import LAW, Car, Limit, Rule
from cosim.types import Preset

COURTESY_PARAMETERS = "laneChangeModel.lcCooperative", "laneChangeModel.lcCooperativeSpeed"
ROUTE_PARAMETER = "laneChangeModel.lcStrategic"  # below 0: no lane changes for the route
MAX_REASON_DISTANCE = 150.0  # m: signals and stop lines further ahead are not named as a reason
RESPECT_FOES = 8  # SUMO's speed mode, bit 3: respect the right of way of approaching foes
IGNORE_INSIDE = 32  # bit 5: ignore the right of way of foes inside the junction
RESPECT_MAX_DECEL = 4  # bit 2: a commanded speed brakes within the driver's `decel`


@dataclass(slots=True)
class Settings:
    """The settings of SUMO's driver in one AV."""

    own: dict[str, str]  # SUMO's parameters before the first command
    changes_for_route: bool = True
    late: bool = False  # whether the driver brakes late, and then as hard as necessary
    impatience: float = 0.0
    mode: int = SPEED_MODE[Preset.LAWFUL]  # whether or not `RESPECT_MAX_DECEL` is off
    set_mode: int = SPEED_MODE[Preset.LAWFUL]  # as last sent to SUMO


class Driver(Rule):
    """Limits the acceleration to that of SUMO's driver.

    Args:
        step: s of a simulation step.
        courteous: whether an AV (its id) slows down for vehicles that must merge, as SUMO's drivers do.
    """

    def __init__(self, step: float, courteous: Callable[[str], bool]) -> None:
        self._step, self._courteous = step, courteous
        self._settings: dict[str, Settings] = {}

    def take_control(self, name: str) -> None:
        """The AV gets its first command."""
        parameters = *COURTESY_PARAMETERS, ROUTE_PARAMETER
        own = {parameter: sumo.vehicle.getParameter(name, parameter) for parameter in parameters}
        self._settings[name] = Settings(own)
        _set_driver(name, LAWFUL_TYPE)
        # all or nothing: a driver with half of it slows down by half of what a gap needs, and opens none
        courtesy = str(float(self._courteous(name)))
        for parameter in COURTESY_PARAMETERS:
            sumo.vehicle.setParameter(name, parameter, courtesy)

    def release_control(self, name: str) -> None:
        """SUMO drives the AV again, comfortably as before."""
        _set_driver(name, LAWFUL_TYPE)
        for parameter, value in self._settings.pop(name).own.items():
            sumo.vehicle.setParameter(name, parameter, value)

    def drop(self, name: str) -> None:
        """The AV is no longer commanded."""
        self._settings.pop(name, None)

    def limit(self, car: Car) -> Limit:
        """The acceleration of SUMO's driver, read or extrapolated from the last step."""
        return Limit((car.driver_speed - car.speed) / self._step, LAW)

    def drive(self, car: Car, strictest: Limit) -> None:
        """Drive the smallest limit of all rules."""
        own, get = self._settings[car.name], sumo.vehicle
        commanded = strictest.reason != LAW and strictest.accel < math.inf
        # A commanded speed brakes within the driver's `decel` unless the speed mode lifts that bound.
        self._set_mode(car.name, own.mode, commanded and strictest.accel < -get.getDecel(car.name))
        if commanded:
            car.requested = max(car.speed + strictest.accel * self._step, 0.0)
            get.setSpeed(car.name, car.requested)
        elif car.commanded:
            get.setSpeed(car.name, -1.0)
        car.commanded, car.last_limit = commanded, strictest
        car.commanded_accel = strictest.accel if commanded else 0.0

    def set_late_braking(self, name: str, late: bool) -> None:
        """Choose between late braking, as hard as necessary, and comfortable braking."""
        own = self._settings[name]
        if late != own.late:
            own.late = late
            _set_driver(name, LATE_TYPE if late else LAWFUL_TYPE, own.impatience)

    def set_changes_for_route(self, name: str, changes: bool) -> None:
        """Whether the driver changes lanes for the route."""
        own = self._settings[name]
        if changes != own.changes_for_route:
            own.changes_for_route = changes
            sumo.vehicle.setParameter(name, ROUTE_PARAMETER, own.own[ROUTE_PARAMETER] if changes else "-1")

    def set_impatience(self, name: str, impatience: float) -> None:
        """Set how hard the AV makes vehicles with priority brake; below 0: not at all."""
        own = self._settings[name]
        if impatience != own.impatience:
            own.impatience = impatience
            # `set_type` gave every AV a type of its own
            sumo.vehicletype.setImpatience(sumo.vehicle.getTypeID(name), impatience)

    def set_priority(self, name: str, first: bool, inside: bool) -> None:
        """Whether the AV ignores approaching foes; with `inside` also the foes inside the junction."""
        mode = SPEED_MODE[Preset.LAWFUL]
        self._settings[name].mode = mode - RESPECT_FOES + inside * IGNORE_INSIDE if first else mode
        self._set_mode(name, self._settings[name].mode, False)

    def reason(self, car: Car) -> str:
        """Why SUMO's driver is slower than the agent asks."""
        get, name = sumo.vehicle, car.name
        speed = get.getSpeed(name)
        horizon = min(0.5 * speed * speed + 2.0 * speed + 10.0, MAX_REASON_DISTANCE)  # m, of IDM braking
        leader = get.getLeader(name, horizon)
        gap = leader[1] if leader and leader[0] else math.inf
        for _, _, distance, light in get.getNextTLS(name)[:1]:
            if distance < min(horizon, gap) and light in RED + YELLOW:
                return "red light" if light in RED else "yellow light"
        if gap < horizon:
            return "vehicle ahead"
        links = get.getNextLinks(name)
        if not links:
            return "lane ends"
        _, priority, _, _, via, state, *_ = links[0]
        if car.to_line < horizon and not priority:
            return "stop sign" if state in "sw" else "right of way"
        if car.to_line < horizon and via and sumo.lane.getMaxSpeed(via) < speed + 1.0:
            return "speed limit"
        return "junction or speed limit"

    # ---- inside ----

    def _set_mode(self, name: str, mode: int, hard: bool) -> None:
        own = self._settings[name]
        mode -= RESPECT_MAX_DECEL * hard
        if mode != own.set_mode:
            own.set_mode = mode
            sumo.vehicle.setSpeedMode(name, mode)


def _lawful_type(own: str, base: str) -> str:
    """The type that drives as `base`, derived from an AV's present type `own`; SUMO's outputs name it."""
    av = own.removesuffix(suffix(LAWFUL_TYPE)).removesuffix(suffix(LATE_TYPE))
    name = f"{av}{suffix(base)}"
    if not is_known(name):
        derive(name, own, base)
    return name


def _set_driver(name: str, kind: str, impatience: float = 0.0) -> None:
    """Give an AV another driver type; the impatience is set apart from the type."""
    set_type(name, _lawful_type(own_type(name), kind))
    sumo.vehicletype.setImpatience(sumo.vehicle.getTypeID(name), impatience)
