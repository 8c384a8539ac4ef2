"""DRAC: the hardest constant braking that an AV or mission vehicle, or its opponent, would have needed;
how often anybody would have needed a hard one."""

from cosim.metrics.context import MetricContext
from cosim.metrics.near_misses import NearMisses
from cosim.types import Metric, Snapshot


class DecelerationRate:
    """Largest over frames and pairs; overlapping pairs (a collision already) are not counted.

    NA when no such vehicle was there, 0 when none was ever on a collision course.
    """

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._conflicts = context.conflicts
        self.near_misses = NearMisses("drac", context.courses)
        self._largest: float | None = None
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        found = self._conflicts.of(snapshot)
        self.near_misses.add(snapshot, found.hard)
        needed = found.deceleration  # [k] m/s2
        if len(needed):
            self._largest = max(self._largest or 0.0, float(needed.max()))

    def result(self) -> dict[str, Metric]:
        return {"max_drac_mps2": Metric(self._largest, "m/s2", "lower"), **self.near_misses.result()}
