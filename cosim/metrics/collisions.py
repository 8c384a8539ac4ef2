"""Collisions: C% of the papers (`crashed`), pairs that touched, and who was to blame."""

from cosim.metrics.context import MetricContext
from cosim.types import Collision, Metric, Snapshot


class Collisions:
    """Every pair of vehicles counts once an episode; definitions.md, Episode."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._pairs: dict[frozenset[str], Collision] = {}

    def add(self, snapshot: Snapshot) -> None:
        for collision in snapshot.events.collisions:
            self._pairs.setdefault(frozenset((collision.collider, collision.victim)), collision)

    def result(self) -> dict[str, Metric]:
        seen = self._pairs.values()
        return {
            "crashed": Metric(bool(seen), "bool", "lower"),
            "collisions": Metric(len(seen), "pairs", "lower"),
            "av_caused_collisions": Metric(sum(c.av_caused for c in seen), "pairs", "lower"),
            "hv_hv_collisions": Metric(
                sum(not c.collider_is_av and not c.victim_is_av for c in seen), "pairs", "lower"
            ),
        }
