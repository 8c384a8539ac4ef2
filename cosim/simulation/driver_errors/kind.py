"""What every kind of error does: whether it can begin, how it begins, goes on and ends."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from cosim.scenario.human_errors import Span
from cosim.seeding import uniform
from cosim.simulation.backend import sumo
from cosim.simulation.driver_errors.surroundings import Place, Surroundings
from cosim.simulation.drivers import Drivers
from cosim.types import HumanError

MIN_SPEED = 1.0  # m/s: a slower driver does not err by driving on
MAX_JUNCTION_TIME = 10.0  # s for driving through a junction
# SUMO's speed mode (Change_Vehicle_State): what a driver who errs no longer heeds
MAX_ACCEL, MAX_DECEL, RIGHT_OF_WAY, RED_LIGHT, INSIDE_JUNCTION = 2, 4, 8, 16, 32
BLIND = 0  # neither speed nor lane-change mode heeds others; own lane changes are off


class Chance(NamedTuple):
    """An error that can begin now."""

    whom: str  # the vehicle that it would meet; "": none
    found: Any = None  # by `eligible`, for `begin`


class Trial(NamedTuple):
    """A trial of a manoeuvre."""

    rate: float  # probability
    which: str  # second or manoeuvre that its number is drawn for
    once: bool  # whether this is the one trial of a manoeuvre, however many seconds it takes


@dataclass(slots=True)
class UnderWay:
    """One error under way, and what is given back when it ends."""

    error: HumanError
    modes: tuple[int, int] = (0, 0)  # speed mode and lane-change mode before
    deceleration: float | None = None  # m/s2, of a driver who holds (0) or lowers its speed
    swerves: tuple[float, int] | None = None  # s, when it changes back, and to which side
    leaves: str = ""  # it ends when the vehicle has left this edge and the junction behind it
    heeds: dict[str, str] | None = None  # what a person heeded before


class ErrorKind:
    """One kind of error.

    Args:
        config: rate and magnitudes (`cosim.scenario.human_errors`).
        around: what is around a driver.
        drivers: the driver models, which pause where an error drives.
        seed: root seed.
        step: s, of the simulation.
    """

    name: ClassVar[str]
    every_second: ClassVar[bool] = False  # drawn every second for every driver; others belong to a manoeuvre
    meets_anybody: ClassVar[bool] = False  # whom it meets is not known before

    def __init__(self, config: Any, around: Surroundings, drivers: Drivers, seed: int, step: float) -> None:
        self.config, self._around, self._drivers, self._seed, self._step = config, around, drivers, seed, step

    def trial(self, who: str, place: Place, now: float) -> Trial | None:
        """The trial of a manoeuvre of `who`, who is at `place`; None where there is none in this second."""
        return None

    def forget(self, who: str) -> None:
        """`who` is inside a junction, or has left the road."""

    def eligible(self, who: str, now: float) -> Chance | None:
        """Whether it can begin; it never depends on a draw."""
        raise NotImplementedError

    def begin(self, who: str, now: float, chance: Chance) -> UnderWay:
        """It begins."""
        raise NotImplementedError

    def step(self, who: str, under_way: UnderWay, now: float) -> bool:
        """It goes on for a simulation step; whether it is over."""
        return now >= under_way.error.until - 1e-6

    def end(self, who: str, under_way: UnderWay) -> None:
        """Give back what was taken."""
        raise NotImplementedError

    def draw(self, who: str, *which: str) -> float:
        """A number in [0, 1)."""
        return uniform(self._seed, "error", self.name, who, *which)

    def magnitude(self, span: Span, who: str, now: float, what: str) -> float:
        """A magnitude of an error that begins now."""
        low, high = span
        return low + (high - low) * self.draw(who, f"{round(now)}", what)

    def begun(self, who: str, now: float, length: float, what: str, near: str) -> UnderWay:
        """One that begins now and lasts `length` s at most."""
        return UnderWay(HumanError(now, who, self.name, now + length, what, near))


class DriverError(ErrorKind):
    """One of a driver: its vehicle is taken from the driver model as far as the error asks for it."""

    def take(self, who: str, under_way: UnderWay, speed_mode: int | None, lane_mode: int = BLIND) -> None:
        """Take the vehicle (`speed_mode` None: not its speed)."""
        vehicle = sumo.vehicle
        under_way.modes = vehicle.getSpeedMode(who), vehicle.getLaneChangeMode(who)
        if speed_mode is not None:
            vehicle.setSpeedMode(who, speed_mode)
        vehicle.setLaneChangeMode(who, lane_mode)
        self._drivers.pause(who)

    def slow(self, who: str, deceleration: float) -> None:
        """One step slower; 0 holds the speed."""
        sumo.vehicle.setSpeed(who, max(self._around.speed_of(who) - deceleration * self._step, 0.0))

    def slows(self, who: str, under_way: UnderWay, deceleration: float) -> UnderWay:
        """It slows down; it still sees its leader and the signals, and may brake harder for them."""
        self.take(who, under_way, sumo.vehicle.getSpeedMode(who) & ~(MAX_ACCEL | MAX_DECEL))
        under_way.deceleration = deceleration
        self.slow(who, deceleration)
        return under_way

    def drives_on(self, who: str, now: float, ignored: int, what: str, near: str) -> UnderWay:
        """It heeds nothing of `ignored` until it is through the junction ahead."""
        under_way = self.begun(who, now, MAX_JUNCTION_TIME, what, near)
        self.take(who, under_way, sumo.vehicle.getSpeedMode(who) & ~ignored | INSIDE_JUNCTION)
        under_way.leaves = sumo.vehicle.getRoadID(who)
        return under_way

    def step(self, who: str, under_way: UnderWay, now: float) -> bool:
        """See `ErrorKind.step`."""
        if super().step(who, under_way, now):
            return True
        if under_way.leaves:
            edge = sumo.vehicle.getRoadID(who)
            if bool(edge) and edge != under_way.leaves and edge[0] != ":":
                return True
        if under_way.deceleration:
            self.slow(who, under_way.deceleration)
        return False

    def end(self, who: str, under_way: UnderWay) -> None:
        """See `ErrorKind.end`."""
        if under_way.deceleration is not None:
            sumo.vehicle.setSpeed(who, -1.0)
        sumo.vehicle.setSpeedMode(who, under_way.modes[0])
        sumo.vehicle.setLaneChangeMode(who, under_way.modes[1])
        self._drivers.resume(who)
