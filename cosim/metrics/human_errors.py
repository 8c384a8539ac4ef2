"""Errors of human drivers and persons, and collisions that involve one."""

from cosim.metrics.context import MetricContext
from cosim.types import Metric, Snapshot


class HumanErrors:
    """Errors that began, and pairs with `Collision.human_error_involved` (figures.md, Collisions)."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._begun = 0
        self._pairs: set[frozenset[str]] = set()

    def add(self, snapshot: Snapshot) -> None:
        self._begun += len(snapshot.events.errors)
        for c in snapshot.events.collisions:
            if c.human_error_involved and not c.insertion:
                self._pairs.add(frozenset((c.collider, c.victim)))

    def result(self) -> dict[str, Metric]:
        return {
            "human_errors": Metric(self._begun, "errors", ""),
            "human_error_collisions": Metric(len(self._pairs), "pairs", "lower"),
        }
