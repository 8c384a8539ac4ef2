"""What is around a driver who may err: lines, signals, gaps beside it, vehicles with the right of way."""

import math
from typing import NamedTuple

from cosim.road import RoadMap
from cosim.simulation.backend import sumo
from cosim.simulation.convert import may_change
from cosim.simulation.mobil import LEFT

LOOKAHEAD = 100.0  # m, in which others are looked for
MIN_ENTRY_GAP = 1.0  # m, bumper to bumper, ahead and behind: with less a vehicle is beside
MAX_OWN_BRAKING = 9.0  # m/s2: nobody changes lanes to where it cannot stop itself


class Gap(NamedTuple):
    """A place to enter, as the vehicle that comes leaves it."""

    asked: float  # m/s2, the deceleration with which that vehicle can still avoid a contact
    lag: float  # s until it would be there at its speed
    whom: str = ""  # which vehicle; "": none comes


NOBODY = Gap(0.0, math.inf)


class Place(NamedTuple):
    """Where a vehicle is on a lane outside junctions."""

    lane: str
    edge: str
    to_line: float  # m to the lane's end
    gives_way: bool  # whether vehicles give way at that line
    signal: bool  # whether a signal is there


class Surroundings:
    """What SUMO says of vehicles and the road, as the kinds of errors ask for it."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        names = "LaneID", "LanePosition", "Speed"
        self.lane_of, self.position_of, self.speed_of = (sumo.getter("vehicle", name) for name in names)
        self._wants: dict[tuple[str, str], tuple[int, float]] = {}  # route, lane -> `needed_change`
        lanes = road.lanes
        self._gives_way = frozenset(lanes[k.origin].id for k in road.links if k.foes)
        self._signals = frozenset(lanes[k.origin].id for k in road.links if k.signal >= 0)

    def place(self, lane: str, name: str) -> Place | None:
        """Of the vehicle `name` on `lane`, outside junctions; None where the road knows no such lane."""
        number = self._road.index.get(lane, -1)
        if number < 0:
            return None
        found = self._road.lanes[number]
        to_line = found.length - self.position_of(name)
        return Place(lane, found.edge, to_line, lane in self._gives_way, lane in self._signals)

    def needed_change(self, name: str, lane: str) -> tuple[int, float]:
        """To which side its route wants it to change (0: to none), and m that its lane serves the route."""
        key = sumo.vehicle.getRouteID(name), lane
        found = self._wants.get(key)
        if found is None:
            here = next((k for k in sumo.vehicle.getBestLanes(name) if k[0] == lane), None)
            offset, length = (0, math.inf) if here is None else (here[3], here[1])
            found = self._wants[key] = (offset > 0) - (offset < 0), length
        return found

    def left(self, name: str, lane: str) -> float:
        """m until its lane serves its route no more."""
        return self.needed_change(name, lane)[1] - float(self.position_of(name))

    def changing(self, who: str) -> bool:
        """Whether it moves sideways."""
        return bool(sumo.vehicle.getLateralSpeed(who) != 0.0)

    def beside(self, who: str, lane: str, side: int) -> Gap | None:
        """The gap in the lane to that side, as the follower there leaves it; None where there is no such
        lane, or a vehicle in it beside, or just ahead and much slower."""
        edge, _, index = lane.rpartition("_")
        there = int(index) + side
        if not 0 <= there < sumo.edge.getLaneNumber(edge):
            return None
        if not may_change(lane, side, sumo.vehicle.getVehicleClass(who)):
            return None
        bits = 0 if side == LEFT else 1  # of getNeighbors: bit 0 right, bit 1 ahead
        behind, ahead = (
            min(sumo.vehicle.getNeighbors(who, bits | way), key=lambda v: v[1], default=None)
            for way in (0, 2)
        )
        speed = self.speed_of(who)
        if ahead is not None:
            gap = ahead[1] + sumo.vehicle.getMinGap(who)
            if gap < MIN_ENTRY_GAP or _asked(speed - self.speed_of(ahead[0]), gap) > MAX_OWN_BRAKING:
                return None
        if behind is None:
            return NOBODY
        gap, comes = behind[1] + sumo.vehicle.getMinGap(behind[0]), self.speed_of(behind[0])
        if gap < MIN_ENTRY_GAP:
            return None
        slows = max(-sumo.vehicle.getAcceleration(who), 0.0)  # and will go on to, behind its leader
        return Gap(_asked(comes - speed, gap) + slows, _time(gap, comes), behind[0])

    def yields(self, name: str) -> bool:
        """Whether it must give way at the next line, and the signal there lets it go."""
        links = sumo.vehicle.getNextLinks(name)
        return bool(links) and links[0][5] in "mswZ=go"

    def foes(self, who: str) -> list[Gap]:
        """The vehicles with the right of way at the next line that are not gone when `who` is there, driving
        on; `lag` is counted from then. The one that must brake hardest comes first."""
        vehicle, found = sumo.vehicle, []
        links = vehicle.getNextLinks(who)
        speed, gains = self.speed_of(who), vehicle.getAccel(who)
        for foe, away, to, _, beyond, via, _, goes_first, _ in vehicle.getJunctionFoes(who, LOOKAHEAD):
            if not goes_first or via != links[0][4]:
                continue
            arrives = (math.sqrt(speed**2 + 2.0 * gains * max(away, 0.0)) - speed) / gains  # s
            comes = self.speed_of(foe)
            if _time(beyond + vehicle.getLength(foe), comes) > arrives:
                asked = _asked(comes, to) if to > 0.0 else math.inf
                found.append(Gap(asked, _time(to, comes) - arrives, foe))
        return sorted(found, reverse=True)


def follower(who: str) -> str:
    """The vehicle behind; "" where there is none."""
    found = sumo.vehicle.getFollower(who, LOOKAHEAD)
    return found[0] if found else ""


def leader(name: str) -> str:
    """The vehicle ahead; "" where there is none, of a person, and of a vehicle that has left the road."""
    try:
        found = sumo.vehicle.getLeader(name, LOOKAHEAD)
    except sumo.TraCIException:
        return ""
    return found[0] if found else ""


def _asked(closing: float, gap: float) -> float:
    """The deceleration (m/s2) with which a speed difference (m/s) is gone when a gap (m) is used up."""
    return max(closing, 0.0) ** 2 / (2.0 * gap)


def _time(distance: float, speed: float) -> float:
    """s in which a vehicle is there."""
    return distance / max(speed, 0.1)
