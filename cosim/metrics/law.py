"""The law at stop lines: red lights, stop signs, the right of way (figures.md, The law)."""

from functools import cache

from cosim.metrics.context import AV, MetricContext
from cosim.road import Crossing, Link, RoadMap, Rule
from cosim.road.rules import COMFORT_DECEL
from cosim.types import Entry, Metric, Offence, Snapshot

STOPPED_SPEED = 0.5  # m/s, maximum within the last 10 m before a stop sign
HARD_DECEL = 3.0 + 1e-3  # m/s2, above the comfortable 3.0: forbidden to cause for vehicles with priority
LEADER = (
    30.0,
    10.0,
)  # m ahead, or beyond the stopping point with `COMFORT_DECEL`: a leader there excuses braking
PERSON_REACH = 10.0  # m from a crossing: a person there excuses braking
SIGNS = (Rule.STOP, Rule.ALL_WAY_STOP)
MUTUAL_RULES = (Rule.EQUAL, Rule.ALL_WAY_STOP, Rule.ZIPPER)  # equal rank: only collisions count
OPEN_STATES = frozenset(map(ord, "GgoO"))  # states of a green or switched-off signal


def ran_red(entry: Entry) -> bool:
    """Whether the AV entered on red, or on yellow although a comfortable stop was possible."""
    if entry.state in ("y", "Y"):
        return entry.yellow_speed**2 / (2.0 * COMFORT_DECEL) <= entry.yellow_distance
    return entry.state in ("r", "u")


def ran_stop(entry: Entry, link: Link) -> bool:
    """Whether the AV did not stop at a stop sign or a green arrow."""
    asked = entry.state == "s" or (link.signal < 0 and link.rule in SIGNS)
    return asked and entry.least_speed > STOPPED_SPEED


class AvCounts:
    """Base of counts over AVs: NA until an AV appears. `offences`: for replays."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._avs = bool((first.kind == AV).any())
        self.offences: list[Offence] = []

    def add(self, snapshot: Snapshot) -> None:
        self._avs = self._avs or bool((snapshot.kind == AV).any())

    def count(self, value: float, unit: str, better: str = "lower") -> Metric:
        return Metric(value if self._avs else None, unit, better)


class StopLines(AvCounts):
    """Unlawful entries of AVs; failures to yield are judged by the foes' reaction."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        super().reset(first, context)
        self._road, self._ways = context.road, Ways(context.road)
        self._links = context.road.links
        self._before, self._last = first, first
        self._open: list[Entry] = []
        self._red = self._stop = self._way = 0

    def add(self, snapshot: Snapshot) -> None:
        super().add(snapshot)
        if self._open:
            self._open = [entry for entry in self._open if self._goes_on(entry, snapshot)]
        self._before, self._last = self._last, snapshot
        for entry in snapshot.events.entries:
            if entry.inside:  # an entry from the internal waiting position follows a counted entry
                self._open = [e for e in self._open if e.vehicle != entry.vehicle]
            elif ran_red(entry):
                self._red += 1
                light = "yellow" if entry.state in "yY" else "red"
                self._tell(entry, entry.time, f"ran a {light} light")
            if not entry.inside and ran_stop(entry, self._links[entry.link]):
                self._stop += 1
                self._tell(entry, entry.time, f"passed a stop sign at {entry.least_speed:.1f} m/s")
            if entry.foes and self._undecided(entry, snapshot):
                self._open.append(entry)

    def result(self) -> dict[str, Metric]:
        return {
            "red_light_violations": self.count(self._red, "entries"),
            "stop_sign_violations": self.count(self._stop, "entries"),
            "right_of_way_violations": self.count(self._way, "entries"),
        }

    def _goes_on(self, entry: Entry, now: Snapshot) -> bool:
        """Whether to keep following the entry; counts it when a foe begins to brake hard for the AV."""
        waits = not entry.inside and self._road.waits_inside(self._links[entry.link].via)
        if self._links[entry.link].rule not in MUTUAL_RULES and not waits:
            for foe, link in entry.foes:
                if self._made_to_brake(foe, link, entry.vehicle, now):
                    self._way += 1
                    self._tell(entry, now.time, f"made {foe} brake, who had the right of way")
                    return False
        return self._undecided(entry, now)

    def _undecided(self, entry: Entry, now: Snapshot) -> bool:
        """Whether the AV is still in the junction without a collision; counts a collision with a foe."""
        foes = {foe for foe, _ in entry.foes}
        for c in now.events.collisions:
            pair = {*c.vehicles}
            if c.time >= entry.time and entry.vehicle in pair and pair & foes:
                self._way += 1
                self._tell(entry, now.time, f"touched {min(pair & foes)}, who had the right of way")
                return False
        row = now.row.get(entry.vehicle)
        return row is not None and not self._ways.left(entry.link, now, row)

    def _tell(self, entry: Entry, time: float, what: str) -> None:
        self.offences.append(Offence(time, entry.vehicle, what))

    def _made_to_brake(self, foe: str, link: int, av: str, now: Snapshot) -> bool:
        rows = [frame.row.get(foe) for frame in (self._before, self._last, now)]
        if rows[1] is None or rows[2] is None or _braking(self._last, rows[1], now, rows[2]) <= HARD_DECEL:
            return False
        if rows[0] is not None and _braking(self._before, rows[0], self._last, rows[1]) > HARD_DECEL:
            return False  # the foe braked equally hard before
        return not self._ways.excused(link, now, rows[2], now.row.get(av, -1))


def _braking(earlier: Snapshot, row: int, later: Snapshot, then: int) -> float:
    """Mean deceleration between two frames, m/s2."""
    elapsed = later.time - earlier.time
    return float(earlier.speed[row] - later.speed[then]) / elapsed if elapsed > 0.0 else 0.0


def persons_near(now: Snapshot, crossing: Crossing, reach: float) -> bool:
    """Whether persons are at most `reach` m from the centre line of a crossing."""
    rows = now.persons
    return len(rows) > 0 and bool((crossing.away(now.x[rows], now.y[rows]) <= reach).any())


class Ways:
    """Positions on the path of a link: before its line, on its internal lanes, beyond it."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self.crossings = cache(self._crossings)
        self._over: dict[int, list[Crossing]] = {}  # lane -> the crossings over it
        for crossing in road.crossings:
            for lane in crossing.lanes:
                self._over.setdefault(lane, []).append(crossing)

    def left(self, link: int, now: Snapshot, row: int) -> bool:
        """Whether a vehicle that entered by the link has left the junction completely."""
        lane, lanes = int(now.lane[row]), self._road.lanes
        if lane < 0 or lanes[lane].internal:
            return lane not in self._road.inside[link]
        beyond = lanes[lane].edge != lanes[self._road.links[link].target].edge
        return beyond or bool(now.lane_position[row] >= now.length[row])

    def excused(self, link: int, now: Snapshot, row: int, av: int) -> bool:
        """Whether a vehicle on the path of `link` has another reason to brake than the AV in row `av`."""
        lane, inside, target = int(now.lane[row]), self._road.inside[link], self._road.links[link].target
        if lane in inside:
            ahead = (*inside[inside.index(lane) :], target)
        elif lane < 0 or self._road.lanes[lane].edge == self._road.lanes[target].edge:
            return True  # off every lane, or past the junction
        else:
            signal = self._road.links[link].signal
            if 0 <= signal < len(now.signals) and int(now.signals[signal]) not in OPEN_STATES:
                return True
            if signal < 0 and self._road.links[link].rule in SIGNS:
                return True
            ahead = (lane, *inside, target) if lane == self._road.links[link].origin else (lane,)
        near, more = LEADER
        near = max(near, float(now.speed[row]) ** 2 / (2.0 * COMFORT_DECEL) + more)
        start = -float(now.lane_position[row])  # m from its front bumper to the start of the lane
        rest = start + self._road.lanes[lane].length
        comes = lane in inside or (lane == self._road.links[link].origin and rest <= near)
        if comes and any(persons_near(now, crossing, PERSON_REACH) for crossing in self.crossings(link)):
            return True
        stretches = []  # lane, m to its start, whether only vehicles partly on it obstruct
        for k in ahead:
            stretches.append((k, start, False))
            start += self._road.lanes[k].length
        if lane not in inside:
            others = self._road.lanes[lane].successors
            stretches += [(k, rest, True) for k in others if k not in ahead]
        for k, start, leaves in stretches:
            for other in (now.lane == k).nonzero()[0].tolist():
                front, length = start + float(now.lane_position[other]), float(now.length[other])
                if other in (row, av) or (leaves and front - start >= length):
                    continue
                if front > 0.0 and front - length <= near:
                    return True
        return False

    def _crossings(self, link: int) -> tuple[Crossing, ...]:
        """The pedestrian crossings over the internal lanes of a link."""
        if not self._over:
            return ()
        return tuple(
            {one.id: one for lane in self._road.inside[link] for one in self._over.get(lane, ())}.values()
        )
