"""Detects and attributes collisions, once per pair: SUMO's list, and an oriented-box check for AVs."""

from collections.abc import Iterable, Sequence

import numpy as np

from cosim.geometry import Boxes, boxes, overlap, overlapping_pairs
from cosim.road import RoadMap
from cosim.road.too_close import along_one_another, foot, heed_each_other, walks_beside
from cosim.simulation.backend import sumo
from cosim.simulation.commands import Commander, return_to_sumo
from cosim.simulation.conventions import centres
from cosim.simulation.convert import Body
from cosim.simulation.drivers import Drivers
from cosim.types import INSERTION, Collision, Floats, Kind, Overlap, Snapshot

MAX_PARALLEL_ANGLE = np.radians(20.0)  # lanes at a smaller angle do not cross
CUT_IN_WINDOW = 3.0  # s: an AV hit from behind within this time of its lane change had cut in
INSERTION_WINDOW = 1.0  # s
HALTING_SPEED = 0.1  # m/s, SUMO's threshold of a halting vehicle
MIN_DISPLACEMENT = 0.02  # m between two frames; less is standstill
CENTRE_LINE_TOLERANCE = 0.3  # m: a front bumper closer to its lane's centre line is not changing lanes
MIN_DRAWN_SHARE = 0.99  # m of a lane's shape per m of its length; some nets have lanes with less
WRECK_DURATION = 5.0  # s until a wreck is removed
# SUMO's types of a collision with a person (MSLane::detectPedestrianJunctionCollision).
PERSON_COLLISIONS = frozenset({"sharedLane", "crossing", "walkingarea", "junctionPedestrian"})
# Causes of an overlap that is no collision (docs/reference/figures.md, Collisions).
HEIGHTS, ASKEW, LANES = CIRCUMSTANCES = ("different heights", "askew", "lanes too close")
PERSON = Body(Kind.PERSON, False, 0.0, 0.0)


class CollisionDetector:
    """The collided pairs of one episode; each is reported once."""

    def __init__(self) -> None:
        self._pairs: set[frozenset[str]] = set()
        self._overlaps: dict[tuple[frozenset[str], str], Overlap] = {}
        self._reported = 0  # overlaps reported so far
        self._lanes: dict[str, int] = {}  # AV -> its lane in the last snapshot
        self._inserted: dict[str, float] = {}  # vehicle -> s, within the last second
        self._last_snapshot: Snapshot | None = None

    def inserted(self, vehicles: Iterable[str], now: float) -> None:
        """SUMO has inserted these vehicles in the step that just ended."""
        recent = {name: t for name, t in self._inserted.items() if now - t <= INSERTION_WINDOW}
        self._inserted = {**recent, **dict.fromkeys(vehicles, now)}

    def lane_changes(self, snapshot: Snapshot, road: RoadMap, commander: Commander) -> None:
        """Record lane changes of AVs that SUMO drives, for the attribution of cut-ins; the commander records
        those of commanded AVs."""
        before, self._lanes = self._lanes, {}
        for row in np.flatnonzero(snapshot.kind == Kind.AV):
            name, lane = snapshot.ids[row], int(snapshot.lane[row])
            was = before.get(name, lane)
            self._lanes[name] = lane
            on_lanes = lane != was and min(lane, was) >= 0 and name not in commander.controlled
            if on_lanes and road.lanes[lane].edge == road.lanes[was].edge:
                commander.lane_changes[name] = snapshot.time

    def from_sumo(self, bodies: dict[str, Body], changes: dict[str, float], now: float) -> list[Collision]:
        """The collisions that SUMO found in the step that just ended (`getCollisions`).

        `changes`: AV -> s, its last lane change.
        """
        found: list[Collision] = []
        touching = sumo.simulation.getCollidingVehiclesNumber()  # costs less than the list
        for c in sumo.simulation.getCollisions() if touching else ():
            person = c.type in PERSON_COLLISIONS
            names = c.collider, f"person:{c.victim}" if person else c.victim
            if frozenset(names) in self._pairs or any(n not in bodies for n in names[: 1 if person else 2]):
                continue
            self._pairs.add(frozenset(names))
            pair = _poses(c.collider, c.victim, person)
            # Two moving AVs keep SUMO's order: an AV caused the collision either way.
            avs = not person and all(bodies[name].kind == Kind.AV for name in names)
            if pair is not None and not (avs and np.min(pair.speed) > HALTING_SPEED):
                first = mover(self._poses_before(names, pair, now), pair)
                names = names[::-1] if first == 1 else names
            try:
                x, y = sumo.vehicle.getPosition(c.collider)[:2]
            except sumo.TraCIException:
                x = y = float("nan")
            found.append(self._collision(now, names, c.type, "sumo", c.lane, x, y, bodies, changes))
        return found

    def from_boxes(
        self, snapshot: Snapshot, road: RoadMap, bodies: dict[str, Body], changes: dict[str, float]
    ) -> list[Collision]:
        """Overlaps of an AV's box with another box that SUMO did not report (it reports 26 of 28).

        `changes`: AV -> s, its last lane change.
        """
        found = []
        for i, j in overlapping_pairs(boxes(snapshot)):
            if snapshot.kind[i] != int(Kind.AV) and snapshot.kind[j] != int(Kind.AV):
                continue
            names = snapshot.ids[i], snapshot.ids[j]
            if frozenset(names) in self._pairs:
                continue
            if cause := circumstance(snapshot, road, i, j):
                self._overlaps.setdefault((frozenset(names), cause), Overlap(snapshot.time, names, cause))
                continue
            self._pairs.add(frozenset(names))
            pair = boxes(snapshot, np.array([i, j]))
            first = mover(self._poses_before(names, pair, snapshot.time), pair)
            if first is None:  # neither moved more into the other
                first = 0 if snapshot.speed[i] >= snapshot.speed[j] else 1
            a = (i, j)[first]
            lane = road.lanes[snapshot.lane[a]].id if snapshot.lane[a] >= 0 else ""
            x, y = float(snapshot.x[a]), float(snapshot.y[a])
            names = names if first == 0 else names[::-1]
            found.append(self._collision(snapshot.time, names, "overlap", "box", lane, x, y, bodies, changes))
        self._last_snapshot = snapshot
        return found

    def overlaps(self) -> tuple[Overlap, ...]:
        """The overlaps that were no collisions, since the last call."""
        before, self._reported = self._reported, len(self._overlaps)
        return tuple(self._overlaps.values())[before:]

    # ---- inside ----

    def _poses_before(self, names: Sequence[str], pair: Boxes, now: float) -> Boxes:
        """The boxes of two vehicles in the last frame; a new vehicle is moved back by its speed."""
        s = self._last_snapshot
        elapsed = 0.0 if s is None else now - s.time
        columns = [np.array(column, np.float64) for column in pair]
        columns[0] -= elapsed * pair.speed * np.cos(pair.heading)
        columns[1] -= elapsed * pair.speed * np.sin(pair.heading)
        for k, name in enumerate(names):
            if s is not None and (row := s.row.get(name)) is not None:
                for column, before in zip(columns, boxes(s, np.array([row])), strict=True):
                    column[k] = np.asarray(before)[0]
        return Boxes(*columns)

    def _collision(
        self,
        now: float,
        names: Sequence[str],
        kind: str,
        source: str,
        lane: str,
        x: float,
        y: float,
        bodies: dict[str, Body],
        changes: dict[str, float],
    ) -> Collision:
        """`names`: collider and victim."""
        collider, victim = (bodies.get(name, PERSON) for name in names)
        cut_in = now - changes.get(names[1], -np.inf) <= CUT_IN_WINDOW
        inserted = any(now - self._inserted.get(name, -np.inf) <= INSERTION_WINDOW for name in names)
        return Collision(
            time=now,
            collider=names[0],
            victim=names[1],
            collider_is_av=collider.kind == Kind.AV,
            victim_is_av=victim.kind == Kind.AV,
            kind=INSERTION if inserted else kind,
            source=source,
            lane=lane,
            x=x,
            y=y,
            involves_mission=any(body.mission and not body.guessed for body in (collider, victim)),
            av_caused=not inserted
            and (collider.kind == Kind.AV or (victim.kind == Kind.AV and bool(cut_in))),
        )


class Wrecks:
    """Crashed vehicles of an episode that goes on: they stop at once, and are removed `WRECK_DURATION` s
    later."""

    def __init__(self, commander: Commander, drivers: Drivers) -> None:
        self._commander, self._drivers = commander, drivers
        self._since: dict[str, float] = {}  # wreck -> s, the time of the crash
        self._stopped: list[str] = []  # since the last `take`
        self._removed: list[str] = []

    def add(self, collisions: Sequence[Collision]) -> list[str]:
        """Stop the vehicles of these collisions, except of SUMO's insertions; the names of new wrecks."""
        new = []
        on_road = frozenset(sumo.vehicle.getIDList()) if collisions else frozenset()
        for c in collisions:
            for name in c.vehicles:
                if name in on_road and name not in self._since:
                    self._since[name] = c.time
                    new.append(name)
                    self._commander.wreck(name)
                    self._drivers.drop(name)
                    sumo.vehicle.setSpeedMode(name, 0)  # at once, beyond the vehicle's deceleration
                    sumo.vehicle.setLaneChangeMode(name, 0)
                    sumo.vehicle.setSpeed(name, 0.0)
        self._stopped += new
        return new

    def remove(self, now: float) -> bool:
        """Remove wrecks that have stood long enough, with their passengers; whether there were any."""
        due = [name for name, since in self._since.items() if now - since >= WRECK_DURATION - 1e-6]
        on_road = frozenset(sumo.vehicle.getIDList()) if due else frozenset()
        for name in due:
            del self._since[name]
            if name in on_road:
                sumo.vehicle.remove(name)
                self._removed.append(name)
        return bool(due)

    def release(self) -> None:
        """Return the wrecks to SUMO's drivers."""
        for name in self._since.keys() & set(sumo.vehicle.getIDList()):
            return_to_sumo(name)

    def take(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The new wrecks and the removed wrecks, since the last call."""
        found = tuple(self._stopped), tuple(self._removed)
        self._stopped.clear()
        self._removed.clear()
        return found


def mover(before: Boxes, now: Boxes) -> int | None:
    """The vehicle, 0 or 1, that moved into the other; None if neither moved more than the other.

    `before`, `now`: boxes [2] in the last frame and at contact. A standing vehicle never is the mover. Of two
    moving vehicles, it is the vehicle whose present box overlaps the other's previous box. If both do, or
    neither, it is the vehicle that closed more of the last gap to close, among those along the four edge
    normals. Boxes that overlapped before use their smallest overlap.
    """
    dx, dy = np.asarray(now.x - before.x), np.asarray(now.y - before.y)  # [2] m, displacements
    moved = np.hypot(dx, dy) >= MIN_DISPLACEMENT
    if not moved.any():
        return None
    if not moved.all():
        return int(np.argmax(moved))
    into = overlap(now, Boxes(*(np.flip(np.asarray(column)) for column in before)))  # [2]
    if into[0] != into[1]:
        return int(np.argmax(into))
    heading = np.asarray(before.heading)
    angles = np.concatenate([heading, heading + 0.5 * np.pi])  # of the four normals
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)  # [4,2]
    apart = normals @ np.diff([before.x, before.y])[:, 0]  # [4] m
    turned = angles[:, None] - heading
    half = 0.5 * (np.abs(np.cos(turned)) * before.length + np.abs(np.sin(turned)) * before.width)  # [4,2]
    gap = np.abs(apart) - half.sum(axis=1)
    towards = np.sign(apart)[:, None] * (normals @ np.array([dx, dy])) * [1.0, -1.0]  # [4,2] m
    closing = towards.sum(axis=1)
    open_ = (gap > 0.0) & (closing > 0.0)
    last = int(
        np.argmax(np.where(open_, gap / np.where(open_, closing, 1.0), -np.inf) if open_.any() else gap)
    )
    a, b = towards[last]
    return None if abs(a - b) < 1e-6 else int(b > a)


def circumstance(snapshot: Snapshot, road: RoadMap, i: int, j: int) -> str:
    """The cause of an overlap that is no collision; "" for a collision."""
    if not road.connected(int(snapshot.place[i]), int(snapshot.place[j])):
        return HEIGHTS
    if is_askew(snapshot, road, i, j):
        return ASKEW
    return LANES if is_net_fault(snapshot, road, i, j) else ""


def is_net_fault(snapshot: Snapshot, road: RoadMap, i: int, j: int) -> bool:
    """Whether the network makes two vehicles overlap though each follows its own lane.

    Their lanes, which need not heed one another (`heed_each_other`), are too close together; a vehicle waits
    inside a junction; a person is on a walking area; or a lane is drawn too short for the vehicles' gap."""
    footprints, waiting = [], False
    for row in (i, j):
        lane = int(snapshot.lane[row])
        if walks_beside(road, int(snapshot.place[row])):
            continue
        if lane < 0:
            return False
        path = road.path(lane)
        x, y, _ = path.pose(np.array([snapshot.lane_position[row] * path.scale]))
        front = _end(snapshot, row, 0.5)
        if np.hypot(front[0] - x[0], front[1] - y[0]) > CENTRE_LINE_TOLERANCE:
            return False
        behind = snapshot.length[row] - snapshot.lane_position[row] * path.scale
        footprints.append(foot(road, lane, behind, _end(snapshot, row, -0.5)))
        waiting |= snapshot.speed[row] < HALTING_SPEED and road.waits_inside(lane)
    if len(footprints) == 1 or on_short_lane(snapshot, road, i, j) or on_short_lane(snapshot, road, j, i):
        return True
    related = along_one_another if waiting else heed_each_other
    return not any(related(road, a, b) for a in footprints[0] for b in footprints[1])


def on_short_lane(snapshot: Snapshot, road: RoadMap, last: int, first: int) -> bool:
    """Whether `last` keeps a gap behind `first` by the length of their lane, or of its lane and the next, and
    one of these lanes is drawn shorter than its length."""
    behind, ahead = (int(snapshot.lane[row]) for row in (last, first))
    along = snapshot.lane_position[first] - snapshot.lane_position[last]  # m
    if behind != ahead:
        if ahead not in road.lanes[behind].successors:
            return False
        along += road.lanes[behind].length
    shorter = min(road.path(lane).scale for lane in (behind, ahead)) < MIN_DRAWN_SHARE
    return bool(shorter and along > snapshot.length[first])


def _end(snapshot: Snapshot, row: int, share: float) -> Floats:
    """[2] m, the front (0.5) or the rear (-0.5) of a vehicle."""
    along, heading = share * snapshot.length[row], snapshot.heading[row]
    return np.array([snapshot.x[row] + along * np.cos(heading), snapshot.y[row] + along * np.sin(heading)])


def _poses(vehicle: str, other: str, person: bool) -> Boxes | None:
    """[2] the boxes of a vehicle and another vehicle, or a person; None if one has left the road."""
    rows = []
    try:
        for get, name in ((sumo.vehicle, vehicle), (sumo.person if person else sumo.vehicle, other)):
            x, y = get.getPosition(name)[:2]
            rows.append(
                (x, y, get.getAngle(name), get.getLength(name), get.getWidth(name), get.getSpeed(name))
            )
    except sumo.TraCIException:
        return None
    x, y, angle, length, width, speed = np.array(rows, np.float64).T
    return Boxes(*centres(x, y, angle, 0.5 * length), length, width, speed)


def is_askew(snapshot: Snapshot, road: RoadMap, i: int, j: int) -> bool:
    """Whether two cars in parallel lanes touch only because a car stands askew.

    SUMO moves a front sideways at 1.6 m/s at any speed, and the rear follows over the distance driven. After
    a lane change at a crawl, the rear stays in the lane that the car has left. SUMO's lane-based drivers no
    longer see it there, and no real car can stand so. Aligned with its lane, the car touches no other.
    """
    a, b = int(snapshot.lane[i]), int(snapshot.lane[j])
    if a < 0 or b < 0 or a == b:
        return False
    along = np.array([lane_direction(road, snapshot, row) for row in (i, j)])  # [2] rad, of the lanes
    if abs((along[0] - along[1] + np.pi) % (2 * np.pi) - np.pi) > MAX_PARALLEL_ANGLE:
        return False
    rows = np.array([i, j])
    half, heading = 0.5 * snapshot.length[rows], snapshot.heading[rows]
    aligned = boxes(snapshot, rows)._replace(
        x=snapshot.x[rows] + half * (np.cos(heading) - np.cos(along)),
        y=snapshot.y[rows] + half * (np.sin(heading) - np.sin(along)),
        heading=along,
    )
    return not len(overlapping_pairs(aligned))


def lane_direction(road: RoadMap, snapshot: Snapshot, row: int) -> float:
    """The direction of a vehicle's lane at its front bumper, rad."""
    path = road.path(int(snapshot.lane[row]))
    return float(path.pose(np.array([snapshot.lane_position[row] * path.scale]))[2][0])
