"""CO2 of all vehicles by SUMO's emission model, total and per distance."""

from cosim.metrics.context import MetricContext
from cosim.types import Metric, Snapshot


class Emissions:
    """The rate of a frame holds since the previous frame; NA if SUMO reports no emissions."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._time = first.time
        self._co2 = self._distance = 0.0  # kg, km

    def add(self, snapshot: Snapshot) -> None:
        elapsed, self._time = snapshot.time - self._time, snapshot.time
        vehicles = snapshot.vehicles
        self._co2 += 1e-3 * elapsed * float(vehicles.co2.sum())
        self._distance += 1e-3 * elapsed * float(vehicles.speed.sum())

    def result(self) -> dict[str, Metric]:
        known = self._co2 == self._co2  # nan is not
        rate = self._co2 / self._distance if known and self._distance else None
        return {
            "co2_kg": Metric(self._co2 if known else None, "kg", ""),
            "co2_kg_per_vehicle_km": Metric(rate, "kg/km", "lower"),
        }
