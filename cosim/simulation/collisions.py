"""Finds collisions: SUMO's own list and our oriented-box check for AVs, once per pair, attributed."""

import libsumo
import numpy as np

from cosim.geometry import boxes, overlapping_pairs
from cosim.road import RoadMap
from cosim.simulation.commands import Commander
from cosim.simulation.convert import Body
from cosim.types import Collision, Kind, Snapshot

SIDE_BY_SIDE = np.radians(20.0)  # lanes whose directions differ by less do not cross
CUT_IN_WINDOW = 3.0  # s: an AV that changed lanes so shortly before it was hit from behind had cut in


class CollisionDetector:
    """The pairs of one episode, so that each is reported once."""

    def __init__(self) -> None:
        self._seen: set[frozenset[str]] = set()
        self._lanes: dict[str, int] = {}  # of every AV, in the last snapshot

    def lane_changes(self, snapshot: Snapshot, road: RoadMap, commander: Commander) -> None:
        """Note for the attribution of cut-ins when an AV that SUMO drives has changed lanes, as the commander
        does for those it commands."""
        for row in np.flatnonzero(snapshot.kind == Kind.AV):
            name, lane = snapshot.ids[row], int(snapshot.lane[row])
            before = self._lanes.get(name, lane)
            self._lanes[name] = lane
            on_lanes = lane != before and min(lane, before) >= 0 and name not in commander.controlled
            if on_lanes and road.lanes[lane].edge == road.lanes[before].edge:
                commander.lane_changes[name] = snapshot.time

    def from_sumo(self, bodies: dict[str, Body], changes: dict[str, float], now: float) -> list[Collision]:
        """What SUMO saw in the step that just ended (`getCollisions`).

        `changes`: AV -> when it last changed lanes, s.
        """
        found: list[Collision] = []
        touching = libsumo.simulation.getCollidingVehiclesNumber()  # costs less than the list
        for c in libsumo.simulation.getCollisions() if touching else ():
            pair = frozenset((c.collider, c.victim))
            if pair in self._seen or c.collider not in bodies or c.victim not in bodies:
                continue
            self._seen.add(pair)
            try:
                x, y = libsumo.vehicle.getPosition(c.collider)[:2]
            except libsumo.TraCIException:
                x = y = float("nan")
            found.append(_collision(now, c.collider, c.victim, c.type, "sumo", c.lane, x, y, bodies, changes))
        return found

    def from_boxes(
        self, snapshot: Snapshot, road: RoadMap, bodies: dict[str, Body], changes: dict[str, float]
    ) -> list[Collision]:
        """Overlaps of an AV's box with another vehicle's that SUMO did not report (it reports 26 of 28).

        `changes`: AV -> when it last changed lanes, s.
        """
        found = []
        for i, j in overlapping_pairs(boxes(snapshot)):
            if snapshot.kind[i] != int(Kind.AV) and snapshot.kind[j] != int(Kind.AV):
                continue
            pair = frozenset((snapshot.ids[i], snapshot.ids[j]))
            if pair in self._seen or not road.connected(int(snapshot.lane[i]), int(snapshot.lane[j])):
                continue
            if _only_a_tail(snapshot, road, i, j):
                continue
            self._seen.add(pair)
            dx, dy = snapshot.x[j] - snapshot.x[i], snapshot.y[j] - snapshot.y[i]
            # the collider is the one that has the other ahead; when both have, the faster one
            j_ahead_of_i = dx * np.cos(snapshot.heading[i]) + dy * np.sin(snapshot.heading[i])
            i_ahead_of_j = -dx * np.cos(snapshot.heading[j]) - dy * np.sin(snapshot.heading[j])
            faster = snapshot.speed[i] >= snapshot.speed[j]
            first = faster if (j_ahead_of_i > 0) == (i_ahead_of_j > 0) else j_ahead_of_i > 0
            a, b = (i, j) if first else (j, i)
            lane = road.lanes[snapshot.lane[a]].id if snapshot.lane[a] >= 0 else ""
            x, y = float(snapshot.x[a]), float(snapshot.y[a])
            found.append(
                _collision(
                    snapshot.time, snapshot.ids[a], snapshot.ids[b], "overlap", "box", lane, x, y,
                    bodies, changes,
                )
            )  # fmt: skip
        return found


def _only_a_tail(snapshot: Snapshot, road: RoadMap, i: int, j: int) -> bool:
    """Whether two cars in lanes side by side touch only because one of them stands askew.

    SUMO's front moves sideways at 1.6 m/s however slowly the car drives, and its tail follows over the
    distance driven: after a change at a crawl the car is 30 degrees askew, its tail in the lane that it has
    left, where SUMO's own drivers no longer see it (they are lane-based: it has arrived). No car can drive
    so; laid along its lane, with the front where it is, it touches none.
    """
    a, b = int(snapshot.lane[i]), int(snapshot.lane[j])
    if a < 0 or b < 0 or a == b:
        return False
    along = np.array([_direction(road, snapshot, row) for row in (i, j)])  # [2] rad, of the lanes
    if abs((along[0] - along[1] + np.pi) % (2 * np.pi) - np.pi) > SIDE_BY_SIDE:
        return False
    rows = np.array([i, j])
    half, heading = 0.5 * snapshot.length[rows], snapshot.heading[rows]
    laid = boxes(snapshot, rows)._replace(
        x=snapshot.x[rows] + half * (np.cos(heading) - np.cos(along)),
        y=snapshot.y[rows] + half * (np.sin(heading) - np.sin(along)),
        heading=along,
    )
    return not len(overlapping_pairs(laid))


def _direction(road: RoadMap, snapshot: Snapshot, row: int) -> float:
    """The direction of a vehicle's lane at its front bumper, rad."""
    path = road.path(int(snapshot.lane[row]))
    return float(path.pose(np.array([snapshot.lane_position[row] * path.scale]))[2][0])


def _collision(
    now: float,
    collider: str,
    victim: str,
    kind: str,
    source: str,
    lane: str,
    x: float,
    y: float,
    bodies: dict[str, Body],
    changes: dict[str, float],
) -> Collision:
    hits, hit = bodies[collider], bodies[victim]
    cut_in = now - changes.get(victim, -np.inf) <= CUT_IN_WINDOW
    return Collision(
        time=now,
        collider=collider,
        victim=victim,
        collider_is_av=hits.kind == Kind.AV,
        victim_is_av=hit.kind == Kind.AV,
        kind=kind,
        source=source,
        lane=lane,
        x=x,
        y=y,
        involves_mission=any(body.mission and not body.guessed for body in (hits, hit)),
        av_caused=hits.kind == Kind.AV or (hit.kind == Kind.AV and bool(cut_in)),
    )
