"""What every rule of the lawful car is given, and what it answers."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from cosim.simulation.backend import sumo
from cosim.simulation.commands import Controlled


class Limit(NamedTuple):
    """A rule's answer: of all of them the smallest acceleration is driven, and its reason is reported."""

    accel: float  # m/s2, at most, in the next step
    reason: str = ""  # "": the agent asked for it


TOLERANCE = 1e-3  # m/s: so much slower SUMO's driver still counts as the wish
LAW = "law"  # the reason of a limit with which SUMO's driver drives by itself
FREE = Limit(math.inf)  # a rule that does not apply


@dataclass(slots=True)
class Car(Controlled):
    """One commanded AV, as the rules see it in the step that begins."""

    name: str = ""
    now: float = 0.0  # s
    speed: float = 0.0  # m/s
    before: float = 0.0  # m/s, one step earlier
    lane: str = ""  # "": it is parked, or SUMO carries it elsewhere
    left: float = math.inf  # m to the end of its lane
    inside: bool = False  # on a lane inside a junction
    allowed: float = math.inf  # m/s that SUMO's driver goes to, or would have gone to
    raw: float = 0.0  # m/s2, what the target alone asks for
    accel: float = 0.0  # m/s2, of the wish, whose jerk is bounded
    driven: Limit = FREE  # the limit of the last step
    commanded: bool = False  # whether it was ours, not SUMO's own
    lateral: float = 0.0  # m to the left of its lane's centre
    corrected: float = -math.inf  # s, when it last drove otherwise than asked
    # what the rules tell one another
    headway: float = 0.8  # s to the leader
    stands: float = 2.0  # m to one that stands
    gives_way: bool = False  # at the next junction, or in this one
    goes: bool = False  # it takes a gap of its own choice
    holds: bool = False  # before its line, for an AV that would have to brake hard
    waited: float = 0.0  # s at a line, to give way
    room_until: float = -math.inf  # s, until when it makes room for the vehicle behind
    lets_in_until: float = -math.inf  # s, until when it stops before its line for another AV

    @property
    def makes_room(self) -> bool:
        """Whether the one behind closes in without braking."""
        return self.now < self.room_until

    @property
    def asked(self) -> float:
        """As of every commanded AV."""
        return self.requested if self.commanded else math.inf

    def look(self, now: float) -> None:
        """Read its state from SUMO at `now` (s)."""
        get = sumo.vehicle
        self.now, self.before, self.speed = now, self.speed, get.getSpeed(self.name)
        self.lane = get.getLaneID(self.name)
        self.inside = self.lane.startswith(":")
        place = get.getLanePosition(self.name)
        self.left = sumo.lane.getLength(self.lane) - place if self.lane else math.inf
        # where SUMO's driver drives it is taken to go on as it did; once it stands it may start at any time
        goes_on = max(2.0 * self.speed - self.before, 0.0)
        self.allowed = (get.getSpeedWithoutTraCI(self.name) if self.commanded else goes_on) + TOLERANCE


class Rule:
    """One reason to drive slower than the agent wishes."""

    def limit(self, car: Car) -> Limit:
        """The most that `car` may accelerate in the next step."""
        raise NotImplementedError

    def drop(self, name: str) -> None:
        """The AV is commanded no more."""
