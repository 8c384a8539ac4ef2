"""DRAC: the largest constant deceleration required by an AV or mission vehicle, or its opponent; and the
near-misses of all vehicles by DRAC."""

from cosim.metrics.context import MetricContext
from cosim.metrics.near_misses import NearMisses
from cosim.types import Metric, Snapshot


class DecelerationRate:
    """Largest over frames and pairs; overlapping pairs (a collision already) are not counted.

    NA without such a vehicle, 0 without a collision course.
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
