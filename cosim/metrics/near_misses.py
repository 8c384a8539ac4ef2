"""Near-misses: critical encounters of pairs by one measure, and the vehicle time for their rates."""

from dataclasses import dataclass, field

from cosim.metrics.context import AV, PERSON, MetricContext
from cosim.metrics.lane_courses import LaneCourses, Ways
from cosim.types import Ints, Metric, Snapshot

MIN_PAUSE = 1.0  # s without a grave frame: what follows is another encounter
SETTLED_AFTER = 2.0  # s after which a way that is still open counts as taken


@dataclass(slots=True)
class Encounter:
    """One encounter."""

    pair: tuple[str, str]
    last: float  # s, its last grave frame
    with_av: bool
    counts: bool = False
    open: list[tuple[float, Ways]] = field(default_factory=list)  # grave frames that count on some ways only


class NearMisses:
    """Counts the encounters of one measure, each pair with a vehicle in it by itself."""

    def __init__(self, measure: str, courses: LaneCourses | None = None) -> None:
        """`courses`: of a measure that lets both drive straight on."""
        self._measure = measure  # ttc, drac, pet
        self._courses = courses
        self._met: list[Encounter] = []
        self._now: dict[tuple[str, str], Encounter] = {}  # the newest one of each pair
        self._open: dict[tuple[str, str], None] = {}  # those of which may have some that count on some ways
        self._vehicles = self._avs = False  # whether any has been seen

    def add(self, snapshot: Snapshot, pairs: Ints) -> None:
        """One more frame; `pairs` [p,2]: rows of the two of each pair that is grave in it."""
        s = snapshot
        self._vehicles = self._vehicles or s.vehicles.n > 0
        self._avs = self._avs or bool((s.kind == AV).any())
        self._settle(s)
        for rows in pairs.tolist():
            i, j = sorted(rows)  # ids are sorted
            kinds = {int(s.kind[i]), int(s.kind[j])}
            ways = None if self._courses is None else self._courses.meeting(s, i, j)
            if kinds == {PERSON} or (ways is not None and not ways):
                continue
            pair = s.ids[i], s.ids[j]
            if pair not in self._now or s.time - self._now[pair].last > MIN_PAUSE + 1e-9:
                self._now[pair] = Encounter(pair, s.time, AV in kinds)
                self._met.append(self._now[pair])
            meeting = self._now[pair]
            meeting.last, meeting.counts = s.time, meeting.counts or ways is None
            if ways is not None and not meeting.counts:
                meeting.open.append((s.time, ways))
                self._open[pair] = None

    def _settle(self, s: Snapshot) -> None:
        """Forget grave frames that lay on ways that were not taken."""
        if self._courses is None:
            return
        for pair in tuple(self._open):
            meeting = self._now[pair]
            left = [(time, self._courses.still(ways, s, pair)) for time, ways in meeting.open]
            meeting.open = [(time, ways) for time, ways in left if ways]
            meeting.counts |= any(s.time - time > SETTLED_AFTER for time, _ in meeting.open)
            if meeting.counts:
                meeting.open.clear()
            if not meeting.open:
                del self._open[pair]

    @property
    def counted(self) -> list[Encounter]:
        """The near-misses so far, in the order they began."""
        return [meeting for meeting in self._met if meeting.counts or meeting.open]

    def result(self) -> dict[str, Metric]:
        found = self.counted
        with_av = sum(meeting.with_av for meeting in found)
        counts = {"": (len(found), self._vehicles), "av_": (with_av, self._avs)}
        return {
            f"{prefix}near_misses_{self._measure}": Metric(count if seen else None, "encounters", "lower")
            for prefix, (count, seen) in counts.items()
        }


class Exposure:
    """How long vehicles, and AVs among them, were on the road: what encounters are counted per."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._time = first.time
        self._vehicles = self._avs = 0.0  # s

    def add(self, snapshot: Snapshot) -> None:
        elapsed, self._time = snapshot.time - self._time, snapshot.time
        self._vehicles += elapsed * snapshot.vehicles.n
        self._avs += elapsed * int((snapshot.kind == AV).sum())

    def result(self) -> dict[str, Metric]:
        return {
            "vehicle_hours": Metric(self._vehicles / 3600.0, "h", ""),
            "av_hours": Metric(self._avs / 3600.0, "h", ""),
        }
