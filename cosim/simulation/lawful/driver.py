"""SUMO's driver in the AV, which keeps the law: signals, right of way, limits, persons.

Of its own accord it brakes as hard as it must: where it is slower than all rules, it drives by itself.
"""

import math
from dataclasses import dataclass

from cosim.road.rules import RED, YELLOW
from cosim.simulation.backend import sumo
from cosim.simulation.commands import SPEED_MODE
from cosim.simulation.derived_types import LATE_TYPE, LAWFUL_TYPE, derive, is_known, own_type, suffix
from cosim.simulation.fleet import set_type
from cosim.simulation.lawful.car import LAW, Car, Limit, Rule
from cosim.types import Preset

COURTESY = "laneChangeModel.lcCooperative", "laneChangeModel.lcCooperativeSpeed"
NOTICE = 150.0  # m: signals and stop lines further ahead are no reason yet
HEEDS_NOBODY_OUTSIDE = 8  # bits of a speed mode: in it who comes to the junction is heeded,
HEEDS_NOBODY_INSIDE = 32  # with it those inside are not
BRAKES_WITHIN = 4  # in it a commanded speed asks for no more than the driver's `decel`


@dataclass(slots=True)
class Settings:
    """How SUMO's driver drives one AV."""

    courtesy: dict[str, str]  # before it was commanded
    late: bool = False  # it brakes late, as hard as it must
    impatience: float = 0.0
    mode: int = SPEED_MODE[Preset.LAWFUL]  # but for `BRAKES_WITHIN`
    set_mode: int = SPEED_MODE[Preset.LAWFUL]  # SUMO's now


class Driver(Rule):
    """Limits the acceleration to what SUMO's driver allows.

    Args:
        step: s of a simulation step.
        courtesy: how far it slows down for vehicles that must change lanes, 0 to 1 (SUMO's lcCooperative).
    """

    def __init__(self, step: float, courtesy: float) -> None:
        self._step, self._courtesy = step, courtesy
        self._of: dict[str, Settings] = {}

    def take_over(self, name: str) -> None:
        """The AV is commanded from now on."""
        own = {parameter: sumo.vehicle.getParameter(name, parameter) for parameter in COURTESY}
        self._of[name] = Settings(own)
        _drive_as(name, LAWFUL_TYPE)
        for parameter in own:
            sumo.vehicle.setParameter(name, parameter, str(self._courtesy))

    def hand_back(self, name: str) -> None:
        """It keeps its comfortable driver."""
        _drive_as(name, LAWFUL_TYPE)
        for parameter, value in self._of.pop(name).courtesy.items():
            sumo.vehicle.setParameter(name, parameter, value)

    def drop(self, name: str) -> None:
        """It is commanded no more."""
        self._of.pop(name, None)

    def limit(self, car: Car) -> Limit:
        """What its driver does as it did in the last step, or would have done."""
        return Limit((car.allowed - car.speed) / self._step, LAW)

    def drive(self, car: Car, least: Limit) -> None:
        """Carry out the smallest limit of all rules."""
        own, get = self._of[car.name], sumo.vehicle
        commanded = least.reason != LAW and least.accel < math.inf
        # a commanded speed is bounded by the driver's own deceleration, unless it says otherwise
        self._set_mode(car.name, own.mode, commanded and least.accel < -get.getDecel(car.name))
        if commanded:
            car.requested = max(car.speed + least.accel * self._step, 0.0)
            get.setSpeed(car.name, car.requested)
        elif car.commanded:
            get.setSpeed(car.name, -1.0)
        car.commanded, car.driven = commanded, least
        car.accel = least.accel if commanded else 0.0

    def brake_late(self, name: str, late: bool) -> None:
        """Whether from now on it brakes late, as hard as it must."""
        own = self._of[name]
        if late != own.late:
            own.late = late
            _drive_as(name, LATE_TYPE if late else LAWFUL_TYPE, own.impatience)

    def be_impatient(self, name: str, impatience: float) -> None:
        """How much it makes others brake who have the right of way; below 0: not at all."""
        own = self._of[name]
        if impatience != own.impatience:
            own.impatience = impatience
            # its type is its own since `set_type`
            sumo.vehicletype.setImpatience(sumo.vehicle.getTypeID(name), impatience)

    def go_first(self, name: str, goes: bool, inside: bool) -> None:
        """Whether it heeds nobody who comes to the junction; `inside` it nobody there either."""
        mode = SPEED_MODE[Preset.LAWFUL]
        self._of[name].mode = mode - HEEDS_NOBODY_OUTSIDE + inside * HEEDS_NOBODY_INSIDE if goes else mode
        self._set_mode(name, self._of[name].mode, False)

    def reason(self, car: Car) -> str:
        """Why SUMO's driver is slower than the agent wishes."""
        get, name = sumo.vehicle, car.name
        speed = get.getSpeed(name)
        reach = min(0.5 * speed * speed + 2.0 * speed + 10.0, NOTICE)  # m, from where an IDM begins to brake
        leader = get.getLeader(name, reach)
        gap = leader[1] if leader and leader[0] else math.inf
        for _, _, distance, light in get.getNextTLS(name)[:1]:
            if distance < min(reach, gap) and light in RED + YELLOW:
                return "red light" if light in RED else "yellow light"
        if gap < reach:
            return "vehicle ahead"
        links = get.getNextLinks(name)
        if not links:
            return "lane ends"
        _, priority, _, _, via, state, *_ = links[0]
        if car.left < reach and not priority:
            return "stop sign" if state in "sw" else "right of way"
        if car.left < reach and via and sumo.lane.getMaxSpeed(via) < speed + 1.0:
            return "speed limit"
        return "junction or speed limit"

    # ---- inside ----

    def _set_mode(self, name: str, mode: int, hard: bool) -> None:
        own = self._of[name]
        mode -= BRAKES_WITHIN * hard
        if mode != own.set_mode:
            own.set_mode = mode
            sumo.vehicle.setSpeedMode(name, mode)


def _lawful(own: str, base: str) -> str:
    """The type of a commanded AV whose present one is this, driving as `base`; outputs name it."""
    av = own.removesuffix(suffix(LAWFUL_TYPE)).removesuffix(suffix(LATE_TYPE))
    name = f"{av}{suffix(base)}"
    if not is_known(name):
        derive(name, own, base)
    return name


def _drive_as(name: str, kind: str, impatience: float = 0.0) -> None:
    """Give an AV another driver; how impatient it is no type decides."""
    set_type(name, _lawful(own_type(name), kind))
    sumo.vehicletype.setImpatience(sumo.vehicle.getTypeID(name), impatience)
