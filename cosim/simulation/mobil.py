"""Reference lane changing of human drivers: IDM and the MOBIL rule as pure functions, and MOBIL driving SUMO.

Paper P, section V-A.2: dv/dt = a [1 - (v/v0)^4 - (d*/d)^2], d* = d0 + v T + v dv / (2 sqrt(a b)) (IDM);
change lanes if a_n' > -b_safe and (a_ego' - a_ego) + p [(a_n' - a_n) + (a_o' - a_o)] > a_th (MOBIL,
Kesting, Treiber and Helbing 2007). n: the new follower, o: the old one; ': after the change.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from cosim.scenario.behaviors import IdmParameters, MobilParameters
from cosim.simulation.backend import sumo

FAR = 1.0e6  # m: the gap without a leader
TOUCHING = 0.01  # m: smaller gaps (also overlaps) brake as hard as this one

LEFT, RIGHT = 1, -1

# laneChangeMode bits (SUMO, "Vehicle Value Changing / change lane mode"): strategic changes unless they
# contradict ours (bits 0-1 = 01), no cooperative, speed-gain or keep-right changes, and our requests refused
# only where vehicles would overlap (bits 8-9 = 01): the safety criterion is MOBIL's own.
STRATEGIC_ONLY = 0b01_00_00_00_01

LOOK_AHEAD = 300.0  # m beyond the end of the lane; on the lane itself SUMO looks without limit

# A lane that ends (or leaves the route) nearer than this is no target for a discretionary change: the way
# there and back, as LC2013's own look-ahead of 10 s each way.
RETURN_TIME = 20.0  # s
CONFLICT_RANGE = 60.0  # m: two requests of one step into one lane this close: the first one goes


class Car(NamedTuple):
    """The state of one vehicle that MOBIL needs."""

    speed: float  # m/s
    desired_speed: float  # m/s, v0
    length: float  # m
    idm: IdmParameters


class Beside(NamedTuple):
    """A car ahead or behind and the bumper-to-bumper gap to it."""

    gap: float  # m
    car: Car


class Situation(NamedTuple):
    """The vehicles that a lane change concerns; None where there is none."""

    ego: Car
    leader: Beside | None
    follower: Beside | None
    new_leader: Beside | None
    new_follower: Beside | None


class Accelerations(NamedTuple):
    """IDM accelerations in m/s2 without and with the change; 0 and 0 for a follower who is not there."""

    ego: float
    ego_after: float
    new_follower: float
    new_follower_after: float
    old_follower: float
    old_follower_after: float


def idm_acceleration(
    idm: IdmParameters, speed: float, desired_speed: float, gap: float = FAR, leader_speed: float = 0.0
) -> float:
    """IDM acceleration in m/s2 (P, section V-A.2).

    Args:
        idm: the driver's parameters.
        speed, desired_speed: v and v0, m/s.
        gap: m, bumper to bumper, to the leader (FAR: a free road).
        leader_speed: m/s.

    The desired gap never falls below d0 (Treiber's max(0, .)): opening gaps do not repel.
    """
    free = 1.0 - (speed / max(desired_speed, 0.1)) ** 4
    if gap >= FAR:
        return idm.max_acceleration * free
    root = 2.0 * math.sqrt(idm.max_acceleration * idm.comfortable_deceleration)
    desired_gap = idm.minimum_gap + max(0.0, speed * idm.time_headway + speed * (speed - leader_speed) / root)
    return idm.max_acceleration * (free - (desired_gap / max(gap, TOUCHING)) ** 2)


def _follow(car: Car, ahead: Beside | None) -> float:
    gap, leader_speed = (FAR, 0.0) if ahead is None else (ahead.gap, ahead.car.speed)
    return idm_acceleration(car.idm, car.speed, car.desired_speed, gap, leader_speed)


def _follower(behind: Beside | None, ego: Car, ahead: Beside | None) -> tuple[float, float]:
    """Acceleration in m/s2 of a follower behind `ego`, and behind `ahead` across ego's place."""
    if behind is None:
        return 0.0, 0.0
    beyond = None if ahead is None else Beside(behind.gap + ego.length + ahead.gap, ahead.car)
    return _follow(behind.car, Beside(behind.gap, ego)), _follow(behind.car, beyond)


def accelerations(s: Situation) -> Accelerations:
    """What the change does to the changer, the new and the old follower (each with its own parameters)."""
    new_after, new = _follower(s.new_follower, s.ego, s.new_leader)
    old, old_after = _follower(s.follower, s.ego, s.leader)
    return Accelerations(
        _follow(s.ego, s.leader), _follow(s.ego, s.new_leader), new, new_after, old, old_after
    )


def incentive(a: Accelerations, politeness: float) -> float:
    """Left side of the MOBIL inequality in m/s2; politeness 0 is the egoistic advantage."""
    others = (a.new_follower_after - a.new_follower) + (a.old_follower_after - a.old_follower)
    return (a.ego_after - a.ego) + politeness * others


def best_incentive(own: Situation, politeness: float) -> float:
    """Upper bound of the incentive in m/s2, reached in an empty lane: no need to look beside below it."""
    return incentive(accelerations(own._replace(new_leader=None, new_follower=None)), politeness)


def is_safe(a: Accelerations, mobil: MobilParameters) -> bool:
    """The new follower need not brake harder than b_safe, nor need the changer itself behind its new leader.

    The second half is not in P's formula: with p = 1 a driver could otherwise pay any price for others.
    """
    return a.new_follower_after > -mobil.safe_deceleration and a.ego_after > -mobil.safe_deceleration


def worth(a: Accelerations, mobil: MobilParameters) -> float | None:
    """MOBIL's verdict: the incentive (m/s2) of a change that is safe and beats the threshold, else None."""
    gain = incentive(a, mobil.politeness)
    return gain if gain > mobil.threshold and is_safe(a, mobil) else None


# ---------------------------------------------------------------- reading and commanding SUMO


def read_car(vehicle: str, known: IdmParameters | None = None) -> Car:
    """A vehicle's state; IDM parameters as SUMO has them unless `known` (AVs and foreign types are read)."""
    get = sumo.vehicle
    idm = known or IdmParameters(
        get.getTau(vehicle), get.getMinGap(vehicle), get.getAccel(vehicle), get.getDecel(vehicle)
    )
    return Car(get.getSpeed(vehicle), get.getAllowedSpeed(vehicle), get.getLength(vehicle), idm)


Known = Callable[[str], IdmParameters | None]


def _neighbor(
    found: tuple[str, float] | None, ego: str, known: Known, minimum_gap: float | None = None
) -> Beside | None:
    """SUMO's gaps are net of the rear vehicle's minGap (`minimum_gap` m; None: the found vehicle is the rear
    one); ours are bumper to bumper."""
    if not found or not found[0] or found[0] == ego:
        return None
    car = read_car(found[0], known(found[0]))
    return Beside(found[1] + (car.idm.minimum_gap if minimum_gap is None else minimum_gap), car)


def read_own_lane(vehicle: str, known: Known) -> Situation:
    """The vehicle, its leader and its follower; the next lanes are not read yet."""
    get = sumo.vehicle
    ego = read_car(vehicle, known(vehicle))
    leader = _neighbor(get.getLeader(vehicle, LOOK_AHEAD), vehicle, known, ego.idm.minimum_gap)
    return Situation(ego, leader, _neighbor(get.getFollower(vehicle, LOOK_AHEAD), vehicle, known), None, None)


def read_beside(own: Situation, vehicle: str, direction: int, known: Known) -> Situation:
    """`own` completed by the neighbours in the next lane to the LEFT or RIGHT.

    A vehicle in the middle of its own change is already seen in the lane that it enters.
    """
    side = 0 if direction == LEFT else 1  # getNeighbors: bit 0 = right side, bit 1 = those ahead
    ahead, behind = (
        min(sumo.vehicle.getNeighbors(vehicle, which | side), key=lambda v: v[1], default=None)
        for which in (2, 0)
    )
    return own._replace(
        new_leader=_neighbor(ahead, vehicle, known, own.ego.idm.minimum_gap),
        new_follower=_neighbor(behind, vehicle, known),
    )


def changing(vehicle: str) -> bool:
    """Whether a lane change of the vehicle is under way."""
    return bool(sumo.vehicle.getLateralSpeed(vehicle) != 0.0)


def route_allows(vehicle: str, direction: int) -> bool:
    """Whether there is a lane that serves the route as well as this one, or lasts long enough to return."""
    lanes = sumo.vehicle.getBestLanes(vehicle)
    here = sumo.vehicle.getLaneID(vehicle)
    index = next((i for i, lane in enumerate(lanes) if lane[0] == here), -1)
    target = index + direction
    if index < 0 or not 0 <= target < len(lanes):  # inside a junction, or no lane on that side
        return False
    if abs(lanes[target][3]) <= abs(lanes[index][3]) and lanes[target][1] >= lanes[index][1]:
        return True
    remaining = lanes[target][1] - sumo.vehicle.getLanePosition(vehicle)
    return bool(remaining > RETURN_TIME * max(sumo.vehicle.getSpeed(vehicle), 1.0))


class MobilDriving:
    """Drives the lane changes of HVs by MOBIL; SUMO keeps only those that the route needs.

    Each driver decides once per `period`, at a phase of its own, so that drivers neither decide all in one
    step nor two of them take the same gap at once. 1 s is also the shortest interval between two lane changes
    in the simulator of P's lineage (HighwayEnv).
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._drivers: dict[str, tuple[IdmParameters, MobilParameters]] = {}
        self._due: list[list[str]] = []
        self._steps = 0
        self.paused: set[str] = set()  # decide nothing for now

    def known(self, vehicle: str) -> IdmParameters | None:
        """Parameters of a driver of ours, None for another vehicle."""
        return self._drivers.get(vehicle, (None,))[0]

    def add(self, vehicle: str, idm: IdmParameters, mobil: MobilParameters, phase: float) -> None:
        """Take over one HV; `phase` in [0, 1) of the period."""
        if not self._due:
            self._due = [[] for _ in range(max(1, round(self._period / sumo.simulation.getDeltaT())))]
        sumo.vehicle.setLaneChangeMode(vehicle, STRATEGIC_ONLY)
        self._drivers[vehicle] = (idm, mobil)
        self._due[int(phase * len(self._due))].append(vehicle)

    def drop(self, vehicle: str) -> None:
        """This one decides no more."""
        self._due = [[name for name in turn if name != vehicle] for turn in self._due]

    def step(self) -> None:
        """Decide for the drivers whose turn it is."""
        if not self._due:
            return
        turn = self._steps % len(self._due)
        self._steps += 1
        on_road: list[str] = []
        requested: list[tuple[str, int, float]] = []  # edge, target lane's index, m along it, of this step
        for vehicle in self._due[turn]:
            try:
                direction = self._decide(vehicle)
            except sumo.TraCIException:  # it has left the road
                del self._drivers[vehicle]
                continue
            on_road.append(vehicle)
            if direction and _gap_is_free(vehicle, direction, requested):
                sumo.vehicle.changeLaneRelative(vehicle, direction, 0.0)
        self._due[turn] = on_road

    def _decide(self, vehicle: str) -> int:
        if vehicle in self.paused or changing(vehicle):
            return 0
        mobil = self._drivers[vehicle][1]
        edge = sumo.vehicle.getRoadID(vehicle)
        if not edge or edge[0] == ":":  # not inserted yet, teleporting, or inside a junction
            return 0
        own = read_own_lane(vehicle, self.known)
        if best_incentive(own, mobil.politeness) <= mobil.threshold:
            return 0
        lane, lanes = sumo.vehicle.getLaneIndex(vehicle), sumo.edge.getLaneNumber(edge)
        best, best_gain = 0, 0.0
        for direction in (LEFT, RIGHT):
            if not 0 <= lane + direction < lanes:
                continue
            gain = worth(accelerations(read_beside(own, vehicle, direction, self.known)), mobil)
            if gain is not None and (not best or gain > best_gain) and route_allows(vehicle, direction):
                best, best_gain = direction, gain
        return best


def _gap_is_free(vehicle: str, direction: int, requested: list[tuple[str, int, float]]) -> bool:
    """Whether no earlier request of this step is for the same gap; this one is then added to `requested`."""
    get = sumo.vehicle
    edge, lane = get.getRoadID(vehicle), get.getLaneIndex(vehicle) + direction
    place = get.getLanePosition(vehicle)
    if any(e == edge and i == lane and abs(p - place) < CONFLICT_RANGE for e, i, p in requested):
        return False
    requested.append((edge, lane, place))
    return True
