"""Surroundings of a human driver: stop lines, signals, adjacent gaps, vehicles with right of way."""

import math
from typing import NamedTuple

from cosim.road import RoadMap
from cosim.simulation.backend import sumo
from cosim.simulation.convert import may_change
from cosim.simulation.mobil import LEFT

LOOKAHEAD = 100.0  # m, search range for leaders, followers and foes
MIN_ENTRY_GAP = 1.0  # m, bumper to bumper, to leader and follower; a nearer vehicle blocks the lane
MAX_OWN_BRAKING = 9.0  # m/s2 that the driver accepts to brake behind the new leader


class Gap(NamedTuple):
    """A gap to enter, with the vehicle that approaches it."""

    drac: float  # m/s2, deceleration rate to avoid a crash (DRAC) of the vehicle
    lag: float  # s until the vehicle is there at its present speed
    vehicle: str = ""  # "": no vehicle approaches


NO_FOLLOWER = Gap(0.0, math.inf)


class Place(NamedTuple):
    """Where a vehicle is on a lane outside junctions."""

    lane: str
    edge: str
    to_line: float  # m to the lane's end
    gives_way: bool  # whether some link from this lane must yield
    signal: bool  # whether a signal controls the lane's end


class Surroundings:
    """Queries on vehicles and the road for the error kinds."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        names = "LaneID", "LanePosition", "Speed"
        self.lane_of, self.position_of, self.speed_of = (sumo.getter("vehicle", name) for name in names)
        self._needed: dict[tuple[str, str], tuple[int, float]] = {}  # (route, lane) -> `needed_change`
        lanes = road.lanes
        self._gives_way = frozenset(lanes[k.origin].id for k in road.links if k.foes)
        self._signals = frozenset(lanes[k.origin].id for k in road.links if k.signal >= 0)

    def place(self, lane: str, name: str) -> Place | None:
        """The place of vehicle `name` on `lane`, outside junctions; None for a lane unknown to the map."""
        number = self._road.index.get(lane, -1)
        if number < 0:
            return None
        found = self._road.lanes[number]
        to_line = found.length - self.position_of(name)
        return Place(lane, found.edge, to_line, lane in self._gives_way, lane in self._signals)

    def needed_change(self, name: str, lane: str) -> tuple[int, float]:
        """Side of the lane change that the route needs (0: none), and m that the lane serves the route."""
        key = sumo.vehicle.getRouteID(name), lane
        found = self._needed.get(key)
        if found is None:
            here = next((k for k in sumo.vehicle.getBestLanes(name) if k[0] == lane), None)
            offset, length = (0, math.inf) if here is None else (here[3], here[1])
            found = self._needed[key] = (offset > 0) - (offset < 0), length
        return found

    def left(self, name: str, lane: str) -> float:
        """m until the lane no longer serves the route."""
        return self.needed_change(name, lane)[1] - float(self.position_of(name))

    def changing(self, name: str) -> bool:
        """Whether the vehicle has a lateral speed."""
        return bool(sumo.vehicle.getLateralSpeed(name) != 0.0)

    def adjacent_gap(self, name: str, lane: str, side: int) -> Gap | None:
        """The gap on the adjacent lane, with its follower. None: no such lane, a vehicle alongside, or a much
        slower leader."""
        edge, _, index = lane.rpartition("_")
        target = int(index) + side
        if not 0 <= target < sumo.edge.getLaneNumber(edge):
            return None
        if not may_change(lane, side, sumo.vehicle.getVehicleClass(name)):
            return None
        bits = 0 if side == LEFT else 1  # of getNeighbors: bit 0 right, bit 1 ahead
        behind, ahead = (
            min(sumo.vehicle.getNeighbors(name, bits | way), key=lambda v: v[1], default=None)
            for way in (0, 2)
        )
        speed = self.speed_of(name)
        if ahead is not None:
            gap = ahead[1] + sumo.vehicle.getMinGap(name)
            if gap < MIN_ENTRY_GAP or _drac(speed - self.speed_of(ahead[0]), gap) > MAX_OWN_BRAKING:
                return None
        if behind is None:
            return NO_FOLLOWER
        gap, follower_speed = behind[1] + sumo.vehicle.getMinGap(behind[0]), self.speed_of(behind[0])
        if gap < MIN_ENTRY_GAP:
            return None
        braking = max(-sumo.vehicle.getAcceleration(name), 0.0)  # assumed to last, behind its leader
        return Gap(_drac(follower_speed - speed, gap) + braking, _arrival(gap, follower_speed), behind[0])

    def must_yield(self, name: str) -> bool:
        """Whether the vehicle must yield at the next stop line, with no red signal there."""
        links = sumo.vehicle.getNextLinks(name)
        return bool(links) and links[0][5] in "mswZ=go"

    def foes(self, name: str) -> list[Gap]:
        """The foes with right of way that have not cleared the junction at the vehicle's earliest arrival,
        from which `lag` counts. The foe with the largest `drac` comes first."""
        vehicle, found = sumo.vehicle, []
        links = vehicle.getNextLinks(name)
        speed, accel = self.speed_of(name), vehicle.getAccel(name)
        for foe, distance, to, _, beyond, via, _, has_priority, _ in vehicle.getJunctionFoes(name, LOOKAHEAD):
            if not has_priority or via != links[0][4]:
                continue
            arrival = (math.sqrt(speed**2 + 2.0 * accel * max(distance, 0.0)) - speed) / accel  # s
            foe_speed = self.speed_of(foe)
            if _arrival(beyond + vehicle.getLength(foe), foe_speed) > arrival:
                decel = _drac(foe_speed, to) if to > 0.0 else math.inf
                found.append(Gap(decel, _arrival(to, foe_speed) - arrival, foe))
        return sorted(found, reverse=True)


def follower(name: str) -> str:
    """The follower; "" for none."""
    found = sumo.vehicle.getFollower(name, LOOKAHEAD)
    return found[0] if found else ""


def leader(name: str) -> str:
    """The leader; "" for none, for a person, and for a vehicle that has left the road."""
    try:
        found = sumo.vehicle.getLeader(name, LOOKAHEAD)
    except sumo.TraCIException:
        return ""
    return found[0] if found else ""


def _drac(closing: float, gap: float) -> float:
    """The deceleration rate to avoid a crash, m/s2: removes the closing speed (m/s) within the gap (m)."""
    return max(closing, 0.0) ** 2 / (2.0 * gap)


def _arrival(distance: float, speed: float) -> float:
    """s to cover `distance` m at `speed` m/s, at least 0.1 m/s."""
    return distance / max(speed, 0.1)
