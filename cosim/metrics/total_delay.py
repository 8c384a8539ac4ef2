"""Total delay: the time lost by all vehicles due to depart, on the road and before insertion."""

import numpy as np

from cosim.metrics.context import MetricContext
from cosim.metrics.slots import grown
from cosim.types import Floats, Metric, Snapshot

SLOWEST_FRACTION = 10  # one in 10 vehicles, rounded up


class TotalDelay:
    """SUMO's time loss plus waiting for insertion, within the counted time; NA if either is unknown."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._everybody = context.everybody
        self._before = first.vehicles.time_loss  # [k] s, of the first slots
        self._loss: Floats = np.zeros(64)  # [slots] s, since each departed
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        slots = self._everybody.of(snapshot)
        self._loss = grown(self._loss, len(self._everybody), 0.0)
        self._loss[slots] = snapshot.vehicles.time_loss

    def result(self) -> dict[str, Metric]:
        everybody = self._everybody
        lost = self._loss[: len(everybody)] + everybody.entry + everybody.rest
        lost[: len(self._before)] -= self._before
        waited, to_come = everybody.waiting
        delay, av = np.concatenate([lost, waited]), np.concatenate([everybody.av, to_come])
        slowest = np.sort(delay)[::-1][: -(-len(delay) // SLOWEST_FRACTION)]
        due = None if np.isnan(waited).any() else len(delay)
        known = not np.isnan(delay).any()
        return {
            "vehicles_due": Metric(due, "vehicles", ""),
            "total_delay_s": _mean(delay, known),
            "total_delay_av_s": _mean(delay[av], known),
            "total_delay_hv_s": _mean(delay[~av], known),
            "total_delay_slowest_tenth_s": _mean(slowest, known),
        }


def _mean(values: Floats, known: bool) -> Metric:
    return Metric(float(values.mean()) if known and len(values) else None, "s", "lower")
