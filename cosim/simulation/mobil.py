"""Reference lane changing of human drivers: IDM and MOBIL as pure functions, and their application in SUMO.

Paper P, section V-A.2: dv/dt = a [1 - (v/v0)^4 - (d*/d)^2], d* = d0 + v T + v dv / (2 sqrt(a b)) (IDM);
change lanes if a_n' > -b_safe and (a_ego' - a_ego) + p [(a_n' - a_n) + (a_o' - a_o)] > a_th (MOBIL,
Kesting, Treiber and Helbing 2007). n: the new follower, o: the old follower; ': after the change.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from cosim.scenario.behaviors import IdmParameters, MobilParameters
from cosim.simulation.backend import sumo

FREE_ROAD = 1.0e6  # m, the gap without a leader
MIN_GAP = 0.01  # m: a smaller gap, or an overlap, counts as this gap

LEFT, RIGHT = 1, -1

# laneChangeMode bits (SUMO, "Vehicle Value Changing / change lane mode"): strategic changes unless they
# contradict the request (bits 0-1 = 01), no cooperative, speed-gain or keep-right changes, and requests
# refused only where vehicles would overlap (bits 8-9 = 01): MOBIL has its own safety criterion.
STRATEGIC_ONLY = 0b01_00_00_00_01

LOOK_AHEAD = 300.0  # m beyond the end of the lane; on the lane itself SUMO looks without limit

# A lane that ends (or leaves the route) sooner is no target of a discretionary change. It must last for the
# way there and back, at LC2013's look-ahead of 10 s each.
RETURN_TIME = 20.0  # s
CONFLICT_RANGE = 60.0  # m: of two closer requests in one step for one lane, only the first is granted


class Car(NamedTuple):
    """The state of one vehicle, as MOBIL uses it."""

    speed: float  # m/s
    desired_speed: float  # m/s, v0
    length: float  # m
    idm: IdmParameters


class Nearby(NamedTuple):
    """A car ahead or behind, and the bumper-to-bumper gap to it."""

    gap: float  # m
    car: Car


class Situation(NamedTuple):
    """The ego and the vehicles around its lane change; None where there is none."""

    ego: Car
    leader: Nearby | None
    follower: Nearby | None
    new_leader: Nearby | None
    new_follower: Nearby | None


class Accelerations(NamedTuple):
    """IDM accelerations in m/s2 without and with the lane change; 0 and 0 for a missing follower."""

    ego: float
    ego_after: float
    new_follower: float
    new_follower_after: float
    old_follower: float
    old_follower_after: float


def idm_acceleration(
    idm: IdmParameters, speed: float, desired_speed: float, gap: float = FREE_ROAD, leader_speed: float = 0.0
) -> float:
    """IDM acceleration in m/s2 (P, section V-A.2).

    Args:
        idm: the driver's parameters.
        speed, desired_speed: v and v0, m/s.
        gap: m, bumper to bumper, to the leader (`FREE_ROAD` without a leader).
        leader_speed: m/s.

    The desired gap never falls below d0 (Treiber's max(0, .)): a leader that pulls away does not shrink it.
    """
    free = 1.0 - (speed / max(desired_speed, 0.1)) ** 4
    if gap >= FREE_ROAD:
        return idm.max_acceleration * free
    root = 2.0 * math.sqrt(idm.max_acceleration * idm.comfortable_deceleration)
    desired_gap = idm.minimum_gap + max(0.0, speed * idm.time_headway + speed * (speed - leader_speed) / root)
    return idm.max_acceleration * (free - (desired_gap / max(gap, MIN_GAP)) ** 2)


def _follow(car: Car, ahead: Nearby | None) -> float:
    gap, leader_speed = (FREE_ROAD, 0.0) if ahead is None else (ahead.gap, ahead.car.speed)
    return idm_acceleration(car.idm, car.speed, car.desired_speed, gap, leader_speed)


def _follower(behind: Nearby | None, ego: Car, ahead: Nearby | None) -> tuple[float, float]:
    """Accelerations in m/s2 of a follower behind `ego`, and behind `ahead` without `ego`."""
    if behind is None:
        return 0.0, 0.0
    beyond = None if ahead is None else Nearby(behind.gap + ego.length + ahead.gap, ahead.car)
    return _follow(behind.car, Nearby(behind.gap, ego)), _follow(behind.car, beyond)


def accelerations(s: Situation) -> Accelerations:
    """The effect on the ego, the new and the old follower, each with its own IDM parameters."""
    new_after, new = _follower(s.new_follower, s.ego, s.new_leader)
    old, old_after = _follower(s.follower, s.ego, s.leader)
    return Accelerations(
        _follow(s.ego, s.leader), _follow(s.ego, s.new_leader), new, new_after, old, old_after
    )


def incentive(a: Accelerations, politeness: float) -> float:
    """The left side of the MOBIL inequality in m/s2; with politeness 0, the ego's own advantage."""
    others = (a.new_follower_after - a.new_follower) + (a.old_follower_after - a.old_follower)
    return (a.ego_after - a.ego) + politeness * others


def best_incentive(own: Situation, politeness: float) -> float:
    """The upper bound of the incentive in m/s2, in an empty lane: below it no other lane need be read."""
    return incentive(accelerations(own._replace(new_leader=None, new_follower=None)), politeness)


def is_safe(a: Accelerations, mobil: MobilParameters) -> bool:
    """Whether neither the new follower nor the ego behind its new leader must brake harder than b_safe.

    The ego's part is not in P's formula. Without it, a driver with p = 1 would brake for others at any cost.
    """
    return a.new_follower_after > -mobil.safe_deceleration and a.ego_after > -mobil.safe_deceleration


def change_gain(a: Accelerations, mobil: MobilParameters) -> float | None:
    """The incentive (m/s2) of a change that is safe and exceeds the threshold, else None."""
    gain = incentive(a, mobil.politeness)
    return gain if gain > mobil.threshold and is_safe(a, mobil) else None


# ---------------------------------------------------------------- reading and commanding SUMO


def read_car(vehicle: str, known: IdmParameters | None = None) -> Car:
    """A vehicle's state; its IDM parameters are `known`, or else read from SUMO (AVs and foreign types)."""
    get = sumo.vehicle
    idm = known or IdmParameters(
        get.getTau(vehicle), get.getMinGap(vehicle), get.getAccel(vehicle), get.getDecel(vehicle)
    )
    return Car(get.getSpeed(vehicle), get.getAllowedSpeed(vehicle), get.getLength(vehicle), idm)


Known = Callable[[str], IdmParameters | None]


def _neighbor(
    found: tuple[str, float] | None, ego: str, known: Known, minimum_gap: float | None = None
) -> Nearby | None:
    """Converts SUMO's gap, net of the rear vehicle's minGap, to bumper to bumper. `minimum_gap`: m, of the
    rear vehicle; None: the found vehicle is the rear vehicle."""
    if not found or not found[0] or found[0] == ego:
        return None
    car = read_car(found[0], known(found[0]))
    return Nearby(found[1] + (car.idm.minimum_gap if minimum_gap is None else minimum_gap), car)


def read_own_lane(vehicle: str, known: Known) -> Situation:
    """The vehicle with its leader and follower; the neighbouring lanes are still missing."""
    get = sumo.vehicle
    ego = read_car(vehicle, known(vehicle))
    leader = _neighbor(get.getLeader(vehicle, LOOK_AHEAD), vehicle, known, ego.idm.minimum_gap)
    return Situation(ego, leader, _neighbor(get.getFollower(vehicle, LOOK_AHEAD), vehicle, known), None, None)


def read_beside(own: Situation, vehicle: str, direction: int, known: Known) -> Situation:
    """`own` with the vehicles in the next lane to the LEFT or RIGHT.

    A vehicle that is changing lanes already counts in its target lane.
    """
    side = 0 if direction == LEFT else 1  # getNeighbors: bit 0 for the right side, bit 1 for vehicles ahead
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
    """Whether the next lane serves the route as well as the present lane, or lasts long enough to return."""
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
    """Drives the lane changes of HVs by MOBIL; SUMO keeps only the changes that the route needs.

    Each driver decides once per `period`, at its own phase. So not all drivers decide in one step, and no two
    take the same gap at once. 1 s is also the shortest interval between two lane changes in the simulator of
    P's lineage (HighwayEnv).
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._drivers: dict[str, tuple[IdmParameters, MobilParameters]] = {}
        self._due: list[list[str]] = []
        self._steps = 0
        self.paused: set[str] = set()  # drivers that decide nothing for now

    def known(self, vehicle: str) -> IdmParameters | None:
        """The IDM parameters of a driver that MOBIL drives; None for another vehicle."""
        return self._drivers.get(vehicle, (None,))[0]

    def add(self, vehicle: str, idm: IdmParameters, mobil: MobilParameters, phase: float) -> None:
        """Add one HV; `phase` in [0, 1) of the period."""
        if not self._due:
            self._due = [[] for _ in range(max(1, round(self._period / sumo.simulation.getDeltaT())))]
        sumo.vehicle.setLaneChangeMode(vehicle, STRATEGIC_ONLY)
        self._drivers[vehicle] = (idm, mobil)
        self._due[int(phase * len(self._due))].append(vehicle)

    def drop(self, vehicle: str) -> None:
        """The driver makes no more decisions."""
        self._due = [[name for name in slot if name != vehicle] for slot in self._due]

    def step(self) -> None:
        """Decide for the drivers of the present time slot."""
        if not self._due:
            return
        slot = self._steps % len(self._due)
        self._steps += 1
        on_road: list[str] = []
        requested: list[tuple[str, int, float]] = []  # edge, target lane index, m along it, in this step
        for vehicle in self._due[slot]:
            try:
                direction = self._decide(vehicle)
            except sumo.TraCIException:  # the vehicle has left the road
                del self._drivers[vehicle]
                continue
            on_road.append(vehicle)
            if direction and _gap_is_free(vehicle, direction, requested):
                sumo.vehicle.changeLaneRelative(vehicle, direction, 0.0)
        self._due[slot] = on_road

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
            gain = change_gain(accelerations(read_beside(own, vehicle, direction, self.known)), mobil)
            if gain is not None and (not best or gain > best_gain) and route_allows(vehicle, direction):
                best, best_gain = direction, gain
        return best


def _gap_is_free(vehicle: str, direction: int, requested: list[tuple[str, int, float]]) -> bool:
    """Whether no earlier request of this step claims the same gap; if so, the request is recorded."""
    get = sumo.vehicle
    edge, lane = get.getRoadID(vehicle), get.getLaneIndex(vehicle) + direction
    position = get.getLanePosition(vehicle)
    if any(e == edge and i == lane and abs(p - position) < CONFLICT_RANGE for e, i, p in requested):
        return False
    requested.append((edge, lane, position))
    return True
