"""The interface of the lawful car's rules: the state of an AV as their input, a limit as their output."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from cosim.simulation.backend import sumo
from cosim.simulation.commands import Controlled


class Limit(NamedTuple):
    """A rule's output: the AV drives the smallest acceleration of all rules and reports its reason."""

    accel: float  # m/s2, the maximum in the next step
    reason: str = ""  # "" for the agent's own wish


STOP_MARGIN = 0.5  # m before a stop line, or the end of a lane
TOLERANCE = 1e-3  # m/s: SUMO's driver may be this much slower and the command still counts as driven
LAW = "law"  # the reason of a limit that SUMO's driver drives by itself
NO_LIMIT = Limit(math.inf)  # the output of a rule that does not apply


@dataclass(slots=True)
class Car(Controlled):
    """The state of one commanded AV at the beginning of a simulation step."""

    name: str = ""
    now: float = 0.0  # s
    speed: float = 0.0  # m/s
    last_speed: float = 0.0  # m/s, one step earlier
    lane: str = ""  # "" while the AV is parked or teleports
    to_line: float = math.inf  # m to the end of the lane, the stop line before a junction
    in_junction: bool = False  # on an internal lane
    driver_speed: float = math.inf  # m/s, the speed of SUMO's driver, or its estimate
    wished: float = 0.0  # m/s2, the agent's wish without the jerk limit
    commanded_accel: float = 0.0  # m/s2 in the last step, 0 if SUMO's driver drove
    last_limit: Limit = NO_LIMIT  # of the last step
    commanded: bool = False  # whether the last speed was commanded, not SUMO's own
    lateral_offset: float = 0.0  # m to the left of the lane's centre line
    last_correction: float = -math.inf  # s, the last time of driving otherwise than asked
    # state that the rules share
    headway: float = 0.8  # s to the leader
    standstill_gap: float = 2.0  # m to a standing leader
    gives_way: bool = False  # at the next junction, or in the present one
    takes_gap: bool = False  # the AV has accepted a gap that SUMO's driver would not take
    held_for_av: bool = False  # the AV waits for AVs with priority that would have to brake hard
    waiting_time: float = 0.0  # s of waiting at a line to give way
    evasion_until: float = -math.inf  # s, the end of an evasion from the follower
    admission_until: float = -math.inf  # s, the end of a stop that admits another AV

    @property
    def evading(self) -> bool:
        """Whether the AV makes room, because a human follower closes in without braking."""
        return self.now < self.evasion_until

    @property
    def expected_speed(self) -> float:
        """See `Controlled`; inf where SUMO's driver drove."""
        return self.requested if self.commanded else math.inf

    def update(self, now: float) -> None:
        """Read the AV's state from SUMO at `now` (s)."""
        get = sumo.vehicle
        self.now, self.last_speed, self.speed = now, self.speed, get.getSpeed(self.name)
        self.lane = get.getLaneID(self.name)
        self.in_junction = self.lane.startswith(":")
        position = get.getLanePosition(self.name)
        self.to_line = sumo.lane.getLength(self.lane) - position if self.lane else math.inf
        if self.commanded:  # a driver that would be faster is read as driving the command
            driver = get.getSpeedWithoutTraCI(self.name)
            self.driver_speed = driver if driver < self.requested - TOLERANCE else math.inf
        else:  # it is taken to keep its acceleration; SUMO may start a standing driver at any time
            self.driver_speed = max(2.0 * self.speed - self.last_speed, 0.0) + TOLERANCE


class Rule:
    """One reason to drive slower than the agent asks."""

    def limit(self, car: Car) -> Limit:
        """The maximum acceleration of `car` in the next step."""
        raise NotImplementedError

    def drop(self, name: str) -> None:
        """The AV is no longer commanded."""
