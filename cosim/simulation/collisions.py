"""Finds collisions: SUMO's own list and our oriented-box check for AVs, once per pair, attributed."""

from collections.abc import Iterable, Sequence

import numpy as np

from cosim.geometry import Boxes, boxes, overlap, overlapping_pairs
from cosim.road import RoadMap
from cosim.road.too_close import along_one_another, foot, heed_each_other, walks_beside
from cosim.simulation.backend import sumo
from cosim.simulation.commands import Commander, hand_back
from cosim.simulation.conventions import centres
from cosim.simulation.convert import Body
from cosim.simulation.drivers import Drivers
from cosim.types import INSERTION, Collision, Floats, Kind, Overlap, Snapshot

SIDE_BY_SIDE = np.radians(20.0)  # lanes whose directions differ by less do not cross
CUT_IN_WINDOW = 3.0  # s: an AV that changed lanes so shortly before it was hit from behind had cut in
JUST_INSERTED = 1.0  # s
HALTING = 0.1  # m/s, SUMO's threshold of a halting vehicle
STANDS = 0.02  # m between two frames, at that speed
ON_CENTRE_LINE = 0.3  # m: a front bumper nearer to its lane's centre line is not changing lanes
DRAWN_WHOLE = 0.99  # m of a lane's shape per m of its length; nets have lanes with less
WRECK_STANDS = 5.0  # s, then it is taken off the road
# SUMO's words for a vehicle that hits a person (MSLane::detectPedestrianJunctionCollision).
OF_PERSONS = frozenset({"sharedLane", "crossing", "walkingarea", "junctionPedestrian"})
# What brings an overlap about that is no collision (docs/reference/figures.md, Collisions).
HEIGHTS, ASKEW, LANES = CIRCUMSTANCES = ("different heights", "askew", "lanes too close")
PERSON = Body(Kind.PERSON, False, 0.0, 0.0)


class CollisionDetector:
    """The pairs of one episode, so that each is reported once."""

    def __init__(self) -> None:
        self._seen: set[frozenset[str]] = set()
        self._overlaps: dict[tuple[frozenset[str], str], Overlap] = {}
        self._told = 0  # of these
        self._lanes: dict[str, int] = {}  # of every AV, in the last snapshot
        self._inserted: dict[str, float] = {}  # vehicle -> s, of the last second
        self._before: Snapshot | None = None  # the last one

    def inserted(self, vehicles: Iterable[str], now: float) -> None:
        """SUMO has put these onto the road in the step that just ended."""
        recent = {name: t for name, t in self._inserted.items() if now - t <= JUST_INSERTED}
        self._inserted = {**recent, **dict.fromkeys(vehicles, now)}

    def lane_changes(self, snapshot: Snapshot, road: RoadMap, commander: Commander) -> None:
        """Note for the attribution of cut-ins when an AV that SUMO drives has changed lanes, as the commander
        does for those it commands."""
        before, self._lanes = self._lanes, {}
        for row in np.flatnonzero(snapshot.kind == Kind.AV):
            name, lane = snapshot.ids[row], int(snapshot.lane[row])
            was = before.get(name, lane)
            self._lanes[name] = lane
            on_lanes = lane != was and min(lane, was) >= 0 and name not in commander.controlled
            if on_lanes and road.lanes[lane].edge == road.lanes[was].edge:
                commander.lane_changes[name] = snapshot.time

    def from_sumo(self, bodies: dict[str, Body], changes: dict[str, float], now: float) -> list[Collision]:
        """What SUMO saw in the step that just ended (`getCollisions`).

        `changes`: AV -> when it last changed lanes, s.
        """
        found: list[Collision] = []
        touching = sumo.simulation.getCollidingVehiclesNumber()  # costs less than the list
        for c in sumo.simulation.getCollisions() if touching else ():
            person = c.type in OF_PERSONS
            names = c.collider, f"person:{c.victim}" if person else c.victim
            if frozenset(names) in self._seen or any(n not in bodies for n in names[: 1 if person else 2]):
                continue
            self._seen.add(frozenset(names))
            pair = _poses(c.collider, c.victim, person)
            # of two AVs that drive SUMO's order stays: to blame is an AV either way
            avs = not person and all(bodies[name].kind == Kind.AV for name in names)
            if pair is not None and not (avs and np.min(pair.speed) > HALTING):
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
        """Overlaps of an AV's box with another's that SUMO did not report (it reports 26 of 28).

        `changes`: AV -> when it last changed lanes, s.
        """
        found = []
        for i, j in overlapping_pairs(boxes(snapshot)):
            if snapshot.kind[i] != int(Kind.AV) and snapshot.kind[j] != int(Kind.AV):
                continue
            names = snapshot.ids[i], snapshot.ids[j]
            if frozenset(names) in self._seen:
                continue
            if excuse := circumstance(snapshot, road, i, j):
                self._overlaps.setdefault((frozenset(names), excuse), Overlap(snapshot.time, names, excuse))
                continue
            self._seen.add(frozenset(names))
            pair = boxes(snapshot, np.array([i, j]))
            first = mover(self._poses_before(names, pair, snapshot.time), pair)
            if first is None:  # neither more than the other
                first = 0 if snapshot.speed[i] >= snapshot.speed[j] else 1
            a = (i, j)[first]
            lane = road.lanes[snapshot.lane[a]].id if snapshot.lane[a] >= 0 else ""
            x, y = float(snapshot.x[a]), float(snapshot.y[a])
            names = names if first == 0 else names[::-1]
            found.append(self._collision(snapshot.time, names, "overlap", "box", lane, x, y, bodies, changes))
        self._before = snapshot
        return found

    def overlaps(self) -> tuple[Overlap, ...]:
        """Those that were no collisions, since this was asked last."""
        before, self._told = self._told, len(self._overlaps)
        return tuple(self._overlaps.values())[before:]

    # ---- inside ----

    def _poses_before(self, names: Sequence[str], pair: Boxes, now: float) -> Boxes:
        """Where two were in the last frame; who was not there yet is moved back by its speed."""
        s = self._before
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
        hits, hit = (bodies.get(name, PERSON) for name in names)
        cut_in = now - changes.get(names[1], -np.inf) <= CUT_IN_WINDOW
        inserted = any(now - self._inserted.get(name, -np.inf) <= JUST_INSERTED for name in names)
        return Collision(
            time=now,
            collider=names[0],
            victim=names[1],
            collider_is_av=hits.kind == Kind.AV,
            victim_is_av=hit.kind == Kind.AV,
            kind=INSERTION if inserted else kind,
            source=source,
            lane=lane,
            x=x,
            y=y,
            involves_mission=any(body.mission and not body.guessed for body in (hits, hit)),
            av_caused=not inserted and (hits.kind == Kind.AV or (hit.kind == Kind.AV and bool(cut_in))),
        )


class Wrecks:
    """The vehicles of crashes in an episode that goes on: they stand at once, whoever drove them, and are
    taken off the road after `WRECK_STANDS` s."""

    def __init__(self, commander: Commander, drivers: Drivers) -> None:
        self._commander, self._drivers = commander, drivers
        self._since: dict[str, float] = {}  # wreck -> s, when it crashed
        self._stopped: list[str] = []  # since the last `take`
        self._removed: list[str] = []

    def add(self, collisions: Sequence[Collision]) -> list[str]:
        """Stop the vehicles of these, and name them; SUMO's insertions onto one another are no crashes."""
        new = []
        on_road = frozenset(sumo.vehicle.getIDList()) if collisions else frozenset()
        for c in collisions:
            for name in () if c.insertion else (c.collider, c.victim):
                if name in on_road and name not in self._since:
                    self._since[name] = c.time
                    new.append(name)
                    self._commander.wreck(name)
                    self._drivers.drop(name)
                    sumo.vehicle.setSpeedMode(name, 0)  # at once, not within its deceleration
                    sumo.vehicle.setLaneChangeMode(name, 0)
                    sumo.vehicle.setSpeed(name, 0.0)
        self._stopped += new
        return new

    def remove(self, now: float) -> bool:
        """Take those off the road that have stood long enough, and whoever rides in them; whether any did."""
        due = [name for name, since in self._since.items() if now - since >= WRECK_STANDS - 1e-6]
        on_road = frozenset(sumo.vehicle.getIDList()) if due else frozenset()
        for name in due:
            del self._since[name]
            if name in on_road:
                sumo.vehicle.remove(name)
                self._removed.append(name)
        return bool(due)

    def release(self) -> None:
        """Let those that stand go: SUMO drives them."""
        for name in self._since.keys() & set(sumo.vehicle.getIDList()):
            hand_back(name)

    def take(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Who has become a wreck, and which wrecks were removed, since this was asked last."""
        found = tuple(self._stopped), tuple(self._removed)
        self._stopped.clear()
        self._removed.clear()
        return found


def mover(before: Boxes, now: Boxes) -> int | None:
    """Which of two vehicles, 0 or 1, moved into the other; None where neither did more than the other.

    `before`, `now`: boxes [2] of the last frame and at contact. A vehicle that stands never did. Of two that
    move it is the one whose box now overlaps the other's box of before, which the other has not brought
    about. Where both do or neither does, it is the one that did more to close the gap that was the last to
    close (of the gaps along the four edge normals; of boxes that overlapped before, the smallest overlap).
    """
    dx, dy = np.asarray(now.x - before.x), np.asarray(now.y - before.y)  # [2] m, own displacements
    moved = np.hypot(dx, dy) >= STANDS
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
    """What brings the overlap of two vehicles about; "" where they have collided."""
    if not road.connected(int(snapshot.place[i]), int(snapshot.place[j])):
        return HEIGHTS
    if only_a_tail(snapshot, road, i, j):
        return ASKEW
    return LANES if the_nets(snapshot, road, i, j) else ""


def the_nets(snapshot: Snapshot, road: RoadMap, i: int, j: int) -> bool:
    """Whether two vehicles overlap though each follows its own lane, on lanes whose drivers need not heed one
    another (`heed_each_other`): the lanes lie too close together, and no driver can help it; or past one that
    waits where the net lets it wait inside a junction, or past a person on a walking area; or one behind the
    other where a lane is drawn shorter than it is, with a gap between them by its length."""
    ways, waits = [], False
    for row in (i, j):
        lane = int(snapshot.lane[row])
        if walks_beside(road, int(snapshot.place[row])):
            continue
        if lane < 0:
            return False
        path = road.path(lane)
        x, y, _ = path.pose(np.array([snapshot.lane_position[row] * path.scale]))
        front = _end(snapshot, row, 0.5)
        if np.hypot(front[0] - x[0], front[1] - y[0]) > ON_CENTRE_LINE:
            return False
        behind = snapshot.length[row] - snapshot.lane_position[row] * path.scale
        ways.append(foot(road, lane, behind, _end(snapshot, row, -0.5)))
        waits |= snapshot.speed[row] < HALTING and road.waits_inside(lane)
    if len(ways) == 1 or drawn_shorter(snapshot, road, i, j) or drawn_shorter(snapshot, road, j, i):
        return True
    heeds = along_one_another if waits else heed_each_other
    return not any(heeds(road, a, b) for a in ways[0] for b in ways[1])


def drawn_shorter(snapshot: Snapshot, road: RoadMap, last: int, first: int) -> bool:
    """Whether `last` is behind `first` by the length of their lane, or of its lane and the next, and one of
    these is drawn shorter than it is long."""
    behind, ahead = (int(snapshot.lane[row]) for row in (last, first))
    along = snapshot.lane_position[first] - snapshot.lane_position[last]  # m
    if behind != ahead:
        if ahead not in road.lanes[behind].successors:
            return False
        along += road.lanes[behind].length
    shorter = min(road.path(lane).scale for lane in (behind, ahead)) < DRAWN_WHOLE
    return bool(shorter and along > snapshot.length[first])


def _end(snapshot: Snapshot, row: int, share: float) -> Floats:
    """[2] m, the front (0.5) or the rear (-0.5) of a vehicle."""
    along, heading = share * snapshot.length[row], snapshot.heading[row]
    return np.array([snapshot.x[row] + along * np.cos(heading), snapshot.y[row] + along * np.sin(heading)])


def _poses(vehicle: str, other: str, person: bool) -> Boxes | None:
    """[2] where a vehicle and another one, or a person, are now; None when one has left the road."""
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


def only_a_tail(snapshot: Snapshot, road: RoadMap, i: int, j: int) -> bool:
    """Whether two cars in lanes side by side touch only because one of them stands askew.

    SUMO's front moves sideways at 1.6 m/s however slowly the car drives, and its tail follows over the
    distance driven: after a change at a crawl the car stands askew, its tail in the lane that it has
    left, where SUMO's own drivers no longer see it (they are lane-based: it has arrived). No car can drive
    so; laid along its lane, with the front where it is, it touches none.
    """
    a, b = int(snapshot.lane[i]), int(snapshot.lane[j])
    if a < 0 or b < 0 or a == b:
        return False
    along = np.array([direction(road, snapshot, row) for row in (i, j)])  # [2] rad, of the lanes
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


def direction(road: RoadMap, snapshot: Snapshot, row: int) -> float:
    """The direction of a vehicle's lane at its front bumper, rad."""
    path = road.path(int(snapshot.lane[row]))
    return float(path.pose(np.array([snapshot.lane_position[row] * path.scale]))[2][0])
