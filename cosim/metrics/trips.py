"""Completed trips of AVs, and interventions of the car controller."""

from cosim.metrics.context import MetricContext
from cosim.metrics.law import AvCounts
from cosim.types import Metric, Snapshot


class Trips(AvCounts):
    """AVs that reached the end of their route without a collision (wrecks that are taken off have not)."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        super().reset(first, context)
        self._known = set(first.avs)
        self._completed: set[str] = set()
        self._crashed: set[str] = set()

    def add(self, snapshot: Snapshot) -> None:
        super().add(snapshot)
        for collision in snapshot.events.collisions:
            self._crashed.update(collision.vehicles)
        if snapshot.events.arrived:
            self._completed.update(self._known.intersection(snapshot.events.arrived) - self._crashed)
        if snapshot.events.departed:
            self._known.update(snapshot.avs)

    def result(self) -> dict[str, Metric]:
        return {"av_trips_completed": self.count(len(self._completed), "vehicles", "higher")}


class Interventions(AvCounts):
    """Number of times the car began to override its agent (`Events.interventions`)."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        super().reset(first, context)
        self._begun = 0

    def add(self, snapshot: Snapshot) -> None:
        super().add(snapshot)
        self._begun += len(snapshot.events.interventions)

    def result(self) -> dict[str, Metric]:
        return {"interventions": self.count(self._begun, "events")}
