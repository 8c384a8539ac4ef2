"""The law: stop lines passed against signals, signs and the right of way; interventions of the car itself."""

from cosim.metrics.context import MetricContext
from cosim.road import Link, RoadMap, Rule
from cosim.types import Entry, Kind, Metric, Snapshot

COMFORTABLE = 3.0  # m/s2: who could stop at yellow with this must
STOPPED = 0.5  # m/s, at most, within the last 10 m before a stop sign
HARD = 3.0  # m/s2, the braking that nobody with the right of way is to be made to do
LEADER = 30.0  # m: a vehicle that near ahead is what one brakes for
SIGNS = (Rule.STOP, Rule.ALL_WAY_STOP)
BY_TURNS = (Rule.EQUAL, Rule.ALL_WAY_STOP, Rule.ZIPPER)  # all wait for one another: only touching counts
GOES = frozenset(map(ord, "GgoO"))  # signal states that let a vehicle go, or are off


class AvCount:
    """What counts events of AVs is NA while no AV has been seen."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._any = bool((first.kind == Kind.AV).any())

    def add(self, snapshot: Snapshot) -> None:
        self._any = self._any or bool((snapshot.kind == Kind.AV).any())

    def metric(self, value: float, unit: str, better: str = "lower") -> Metric:
        return Metric(value if self._any else None, unit, better)


class StopLines(AvCount):
    """Entries of AVs on red, past a stop sign, and against somebody's right of way (definitions.md, The law)."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        super().reset(first, context)
        self._road = context.road
        self._before = self._last = first
        self._red = self._stop = self._way = 0
        self._open: list[Entry] = []

    def add(self, snapshot: Snapshot) -> None:
        super().add(snapshot)
        self._before, self._last, links = self._last, snapshot, self._road.links
        previous = self._before
        if self._open:
            self._open = [e for e in self._open if not self._decided(e, previous, snapshot)]
        for entry in snapshot.events.entries:
            signalled = links[entry.link].signal >= 0
            self._red += ran_red(entry)
            self._stop += ran_stop(entry, links[entry.link])
            ...
