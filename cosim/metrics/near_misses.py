"""Near-misses: encounters of two that came grave by one measure, and the vehicle time they are counted in."""

from cosim.metrics.context import AV, PERSON, MetricContext
from cosim.road.meeting import Meeting
from cosim.types import Ints, Metric, Snapshot

APART = 1.0  # s without a grave frame: what follows is another encounter


class NearMisses:
    """Counts the encounters of one measure, each pair with a vehicle in it by itself."""

    def __init__(self, measure: str, meeting: Meeting) -> None:
        self._measure = measure  # ttc, drac, pet
        self._meeting = meeting
        self._last: dict[tuple[str, str], float] = {}  # pair -> s, its last grave frame
        self._all = self._with_av = 0
        self._vehicles = self._avs = False  # whether any has been seen

    def add(self, snapshot: Snapshot, pairs: Ints) -> None:
        """One more frame; `pairs` [p,2]: rows of the two of each pair that is grave in it."""
        s = snapshot
        self._vehicles = self._vehicles or s.vehicles.n > 0
        self._avs = self._avs or bool((s.kind == AV).any())
        for row, other in pairs.tolist():
            kinds = {int(s.kind[row]), int(s.kind[other])}
            if kinds == {PERSON} or not self._meeting.meet(int(s.lane[row]), int(s.lane[other])):
                continue
            i, j = sorted((row, other))  # ids are sorted
            pair = s.ids[i], s.ids[j]
            if pair not in self._last or s.time - self._last[pair] > APART + 1e-9:
                self._all += 1
                self._with_av += AV in kinds
            self._last[pair] = s.time

    def result(self) -> dict[str, Metric]:
        counts = {"": (self._all, self._vehicles), "av_": (self._with_av, self._avs)}
        return {
            f"{who}near_misses_{self._measure}": Metric(count if seen else None, "encounters", "lower")
            for who, (count, seen) in counts.items()
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
