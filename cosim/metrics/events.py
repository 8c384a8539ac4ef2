"""Teleports and emergency stops, reported separately from collisions (sumo.md)."""

from cosim.metrics.context import MetricContext
from cosim.types import Metric, Snapshot


class TrafficEvents:
    """Counts distinct vehicles, since SUMO repeats an emergency stop every step that it lasts."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._teleported: set[str] = set()
        self._stopped: set[str] = set()

    def add(self, snapshot: Snapshot) -> None:
        self._teleported.update(snapshot.events.teleported)
        self._stopped.update(snapshot.events.emergency_stopped)

    def result(self) -> dict[str, Metric]:
        return {
            "teleports": Metric(len(self._teleported), "vehicles", "lower"),
            "emergency_stops": Metric(len(self._stopped), "vehicles", "lower"),
        }
