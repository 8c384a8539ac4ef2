"""Collisions: C% of the papers (`crashed`), the vehicles involved, and the cause."""

from cosim.metrics.context import MetricContext
from cosim.types import Collision, Metric, Snapshot


class Collisions:
    """Every pair counts once an episode; figures.md, Collisions."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._pairs: dict[frozenset[str], Collision] = {}
        self._removed = 0
        self._uncounted: set[frozenset[str]] = set()

    def add(self, snapshot: Snapshot) -> None:
        for collision in snapshot.events.collisions:
            self._pairs.setdefault(frozenset((collision.collider, collision.victim)), collision)
        self._removed += len(snapshot.events.wrecks_removed)
        self._uncounted |= {frozenset(overlap.vehicles) for overlap in snapshot.events.overlaps}

    def result(self) -> dict[str, Metric]:
        seen = self._pairs.values()
        driven = [c for c in seen if not c.insertion]
        counts = {
            "collisions": len(seen),
            "av_involved_collisions": sum(c.involves_av for c in driven),
            "av_caused_collisions": sum(c.av_caused for c in driven),
            "hv_hv_collisions": sum(not c.involves_av for c in driven),
            "insertion_collisions": len(seen) - len(driven),
        }
        return {
            "crashed": Metric(any(c.crash for c in driven), "bool", "lower"),
            **{name: Metric(count, "pairs", "lower") for name, count in counts.items()},
            "uncounted_overlaps": Metric(len(self._uncounted - self._pairs.keys()), "pairs", ""),
            "wrecks_removed": Metric(self._removed, "vehicles", "lower"),
        }
