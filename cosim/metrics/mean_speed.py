"""Mean speed: total distance over total time of all vehicles on the road."""

from cosim.metrics.context import MetricContext
from cosim.types import Metric, Snapshot


class MeanSpeed:
    """Waiting for insertion is excluded; the total delay includes it."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._time = first.time
        self._distance = self._on_road = 0.0  # m, s

    def add(self, snapshot: Snapshot) -> None:
        elapsed, self._time = snapshot.time - self._time, snapshot.time
        vehicles = snapshot.vehicles
        self._distance += elapsed * float(vehicles.speed.sum())
        self._on_road += elapsed * vehicles.n

    def result(self) -> dict[str, Metric]:
        mean = self._distance / self._on_road if self._on_road else None
        return {"mean_speed_mps": Metric(mean, "m/s", "higher")}
