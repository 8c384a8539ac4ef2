"""The interface of every error kind: eligibility, begin, step and end of an error."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from cosim.scenario.human_errors import Span
from cosim.seeding import uniform
from cosim.simulation.backend import sumo
from cosim.simulation.driver_errors.surroundings import Place, Surroundings
from cosim.simulation.drivers import Drivers
from cosim.types import HumanError

MIN_SPEED = 1.0  # m/s; slower vehicles are not eligible for errors of moving drivers
MAX_JUNCTION_TIME = 10.0  # s for driving through a junction
# bits of SUMO's speed mode (TraCI/Change_Vehicle_State): the checks that an error switches off
MAX_ACCEL, MAX_DECEL, RIGHT_OF_WAY, RED_LIGHT, INSIDE_JUNCTION = 2, 4, 8, 16, 32
BLIND = 0  # speed or lane-change mode without any check; own lane changes are off


class Chance(NamedTuple):
    """An error that can begin now."""

    other: str  # the vehicle that the error would affect; "": none
    found: Any = None  # passed from `eligible` to `begin`


class Trial(NamedTuple):
    """A Bernoulli trial of a manoeuvre."""

    rate: float  # probability
    which: str  # second or manoeuvre: part of the key of the random draw
    once: bool  # one trial per manoeuvre, not one per second


@dataclass(slots=True)
class UnderWay:
    """An active error, and the state to restore at its end."""

    error: HumanError
    modes: tuple[int, int] = (0, 0)  # speed mode and lane-change mode before the error
    deceleration: float | None = None  # m/s2; 0 holds the speed, None leaves it to SUMO
    swerve_back: tuple[float, int] | None = None  # time of the change back, s, and its side
    entry_edge: str = ""  # the error ends beyond this edge and the junction that follows it
    before: dict[str, str] | None = None  # a person's junction model before the error


class ErrorKind:
    """One kind of error.

    Args:
        config: rate and magnitudes (`cosim.scenario.human_errors`).
        around: the surroundings of the drivers.
        drivers: the driver models, which pause during an error.
        seed: root seed.
        step: s, of the simulation.
    """

    name: ClassVar[str]
    every_second: ClassVar[bool] = False  # one trial per second and driver; else one per manoeuvre
    other_unknown: ClassVar[bool] = False  # the affected vehicle is not known in advance

    def __init__(self, config: Any, around: Surroundings, drivers: Drivers, seed: int, step: float) -> None:
        self.config, self._around, self._drivers, self._seed, self._step = config, around, drivers, seed, step

    def trial(self, driver: str, place: Place, now: float) -> Trial | None:
        """The trial of the driver's manoeuvre at `place`; None without a trial in this second."""
        return None

    def forget(self, driver: str) -> None:
        """The vehicle is inside a junction or has left the road."""

    def eligible(self, driver: str, now: float) -> Chance | None:
        """The error that can begin now, or None. Never depends on a random draw."""
        raise NotImplementedError

    def begin(self, driver: str, now: float, chance: Chance) -> UnderWay:
        """Begin the error."""
        raise NotImplementedError

    def step(self, driver: str, under_way: UnderWay, now: float) -> bool:
        """Continue for one simulation step; return whether the error is over."""
        return now >= under_way.error.until - 1e-6

    def end(self, driver: str, under_way: UnderWay) -> None:
        """Restore the state before the error."""
        raise NotImplementedError

    def draw(self, driver: str, *which: str) -> float:
        """A uniform number in [0, 1), hashed from seed, kind, driver and `which`."""
        return uniform(self._seed, "error", self.name, driver, *which)

    def magnitude(self, span: Span, driver: str, now: float, what: str) -> float:
        """A magnitude, drawn uniformly from `span`, of an error that begins now."""
        low, high = span
        return low + (high - low) * self.draw(driver, f"{round(now)}", what)

    def begun(self, driver: str, now: float, length: float, what: str, near: str) -> UnderWay:
        """An error that begins now and lasts at most `length` s."""
        return UnderWay(HumanError(now, driver, self.name, now + length, what, near))


class DriverError(ErrorKind):
    """An error that takes a vehicle from its driver model."""

    def take(self, driver: str, under_way: UnderWay, speed_mode: int | None, lane_mode: int = BLIND) -> None:
        """Set the modes and pause the driver model. `speed_mode` None: SUMO keeps the speed."""
        vehicle = sumo.vehicle
        under_way.modes = vehicle.getSpeedMode(driver), vehicle.getLaneChangeMode(driver)
        if speed_mode is not None:
            vehicle.setSpeedMode(driver, speed_mode)
        vehicle.setLaneChangeMode(driver, lane_mode)
        self._drivers.pause(driver)

    def brake_once(self, driver: str, deceleration: float) -> None:
        """Brake for one simulation step; a `deceleration` of 0 m/s2 holds the speed."""
        sumo.vehicle.setSpeed(driver, max(self._around.speed_of(driver) - deceleration * self._step, 0.0))

    def brake(self, driver: str, under_way: UnderWay, deceleration: float) -> UnderWay:
        """Begin to brake. SUMO still brakes harder for leaders and signals."""
        self.take(driver, under_way, sumo.vehicle.getSpeedMode(driver) & ~(MAX_ACCEL | MAX_DECEL))
        under_way.deceleration = deceleration
        self.brake_once(driver, deceleration)
        return under_way

    def drive_through(self, driver: str, now: float, ignored: int, what: str, near: str) -> UnderWay:
        """Switch off the `ignored` bits of the speed mode until the next junction is passed."""
        under_way = self.begun(driver, now, MAX_JUNCTION_TIME, what, near)
        self.take(driver, under_way, sumo.vehicle.getSpeedMode(driver) & ~ignored | INSIDE_JUNCTION)
        under_way.entry_edge = sumo.vehicle.getRoadID(driver)
        return under_way

    def step(self, driver: str, under_way: UnderWay, now: float) -> bool:
        """See `ErrorKind.step`."""
        if super().step(driver, under_way, now):
            return True
        if under_way.entry_edge:
            edge = sumo.vehicle.getRoadID(driver)
            if bool(edge) and edge != under_way.entry_edge and edge[0] != ":":
                return True
        if under_way.deceleration:
            self.brake_once(driver, under_way.deceleration)
        return False

    def end(self, driver: str, under_way: UnderWay) -> None:
        """See `ErrorKind.end`."""
        if under_way.deceleration is not None:
            sumo.vehicle.setSpeed(driver, -1.0)
        sumo.vehicle.setSpeedMode(driver, under_way.modes[0])
        sumo.vehicle.setLaneChangeMode(driver, under_way.modes[1])
        self._drivers.resume(driver)
