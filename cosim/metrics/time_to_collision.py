"""Time to collision of AVs and mission vehicles with others: smallest value and critical share; and the
near-misses of all vehicles by TTC."""

from cosim.metrics.context import CRITICAL, HORIZON, MetricContext
from cosim.metrics.near_misses import NearMisses
from cosim.types import Metric, Snapshot


class TimeToCollision:
    """Swept oriented boxes at constant velocity; `min_ttc_s` is NA when no vehicle came within 10 s."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._conflicts = context.conflicts
        self.near_misses = NearMisses("ttc", context.courses)
        self._smallest = HORIZON
        self._critical = self._counted = 0  # vehicle-frames
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        found = self._conflicts.of(snapshot)
        self.near_misses.add(snapshot, found.soon)
        nearest = found.time_to_collision  # [k] s
        if not len(nearest):
            return
        self._counted += len(nearest)
        smallest = float(nearest.min())
        self._smallest = min(self._smallest, smallest)
        if smallest < CRITICAL:
            self._critical += int((nearest < CRITICAL).sum())

    def result(self) -> dict[str, Metric]:
        share = self._critical / self._counted if self._counted else None
        return {
            "min_ttc_s": Metric(self._smallest if self._smallest < HORIZON else None, "s", "higher"),
            "ttc_below_1_5_share": Metric(share, "share of vehicle time", "lower"),
            **self.near_misses.result(),
        }
