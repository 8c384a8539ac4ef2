"""Distance driven: means by kind of vehicle (DT of both papers), and the total of all vehicles."""

import numpy as np
import numpy.typing as npt

from cosim.geometry.compiled import compiled
from cosim.metrics.context import AV, MetricContext
from cosim.metrics.slots import Slots, grown
from cosim.types import Bools, Floats, Ints, Metric, Snapshot


class Distance:
    """Mean over vehicles of the metres driven in the counted time (figures.md, Mission and distance).

    The vehicles on the road at the first frame are counted, so that the policy does not affect their choice.
    A vehicle that left keeps its distance. On a road that starts empty (a foreign scenario without warm-up)
    all vehicles are counted. The mission vehicle always counts. Kilometres are of all vehicles.
    """

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._slots = Slots()
        # [slots,5]: frame last seen, speed m/s then, distance driven m, is an AV, is a mission vehicle
        self._tally: Floats = np.zeros((64, 5))
        self._frame = 0
        self._time = first.time
        self._started = first.vehicles.n
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        snapshot = snapshot.vehicles
        slot = self._slots.rows(snapshot.ids)
        self._tally = grown(self._tally, len(self._slots), 0.0)
        elapsed, self._time = snapshot.time - self._time, snapshot.time
        self._frame += 1
        vehicles = snapshot.kind, snapshot.mission, snapshot.speed
        _drive(*vehicles, slot, self._tally, self._frame, elapsed)

    def result(self) -> dict[str, Metric]:
        seen = len(self._slots)
        counted = np.arange(seen) < (self._started or seen)
        driven = self._tally[:seen, 2]
        av, mission = self._tally[:seen, 3] > 0.0, self._tally[:seen, 4] > 0.0
        return {
            "dt_mean_m": _mean(driven[counted]),
            "dt_av_m": _mean(driven[counted & av]),
            "dt_hv_m": _mean(driven[counted & ~av]),
            "dt_mission_m": _mean(driven[mission]),
            "vehicle_km": Metric(float(driven.sum()) / 1000.0, "km", ""),
            "av_km": Metric(float(driven[av].sum()) / 1000.0, "km", ""),
        }


@compiled
def _drive(
    kind: npt.NDArray[np.int8],
    mission: Bools,
    speed: Floats,
    slot: Ints,
    tally: Floats,
    frame: int,
    elapsed: float,
) -> None:
    """Integrate the speeds by the trapezoid rule; positions would include the jump of a teleport."""
    for k in range(len(slot)):
        row = tally[slot[k]]
        if frame > 1 and row[0] == frame - 1:
            row[2] += 0.5 * (row[1] + speed[k]) * elapsed
        row[0], row[1] = frame, speed[k]
        row[3] = 1.0 if kind[k] == AV else 0.0
        if mission[k]:
            row[4] = 1.0


def _mean(values: Floats) -> Metric:
    return Metric(float(values.mean()) if len(values) else None, "m", "higher")
