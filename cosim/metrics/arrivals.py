"""Arrivals: the vehicles that reached the end of their route in the counted time."""

from cosim.metrics.context import MetricContext
from cosim.types import Metric, Snapshot


class Arrivals:
    """Counts of arrivals, without wrecks that were taken off the road."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._everybody = context.everybody
        self._everybody.of(first)
        self._avs = self._humans = 0

    def add(self, snapshot: Snapshot) -> None:
        self._everybody.of(snapshot)
        for vehicle in snapshot.events.arrived:
            if vehicle in self._everybody.wrecks:
                continue
            slot = self._everybody.number(vehicle)
            if slot >= 0 and self._everybody.av[slot]:
                self._avs += 1
            else:
                self._humans += 1

    def result(self) -> dict[str, Metric]:
        avs = self._avs if self._everybody.av.any() else None
        return {
            "arrivals": Metric(self._avs + self._humans, "vehicles", "higher"),
            "arrivals_av": Metric(avs, "vehicles", "higher"),
            "arrivals_hv": Metric(self._humans, "vehicles", "higher"),
        }
