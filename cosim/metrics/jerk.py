"""Jerk: the mean absolute rate of change of the AVs' acceleration, a measure of comfort."""

import numpy as np
import numpy.typing as npt

from cosim.geometry.compiled import compiled
from cosim.metrics.context import AV, MetricContext
from cosim.metrics.slots import Slots, grown
from cosim.types import Floats, Ints, Kind, Metric, Snapshot


class Jerk:
    """Second difference of the speeds of three frames in a row, mean over AVs and time."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._slots = Slots()
        # [slots,3]: the frame's number, speed m/s then, mean acceleration m/s2 up to then (NaN unknown)
        self._last: Floats = np.full((64, 3), np.nan)
        self._frame = 0
        self._time = first.time
        self._sum = 0.0  # m/s3
        self._counted = 0
        self._wrecks: set[str] = set()  # their sudden stop is excluded
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        slot = self._slots.rows(snapshot.ids)
        self._last = grown(self._last, len(self._slots), np.nan)
        elapsed, self._time = snapshot.time - self._time, snapshot.time
        self._frame += 1
        self._wrecks.update(snapshot.events.wrecked)
        kind = snapshot.kind
        if self._wrecks:
            kind = np.where([name in self._wrecks for name in snapshot.ids], Kind.HV, kind).astype(np.int8)
        total, counted = _jerks(kind, snapshot.speed, slot, self._last, self._frame, elapsed)
        self._sum += total
        self._counted += counted

    def result(self) -> dict[str, Metric]:
        mean = self._sum / self._counted if self._counted else None
        return {"mean_abs_jerk_mps3": Metric(mean, "m/s3", "lower")}


@compiled
def _jerks(
    kind: npt.NDArray[np.int8], speed: Floats, slot: Ints, last: Floats, frame: int, elapsed: float
) -> tuple[float, int]:
    """Sum (m/s3) and number of the AVs' jerks in this frame; `last` [slots,3] is brought up to date."""
    total, counted = 0.0, 0
    for k in range(len(slot)):
        if kind[k] != AV:
            continue
        memory = last[slot[k]]
        accel = np.nan
        if memory[0] == frame - 1 and elapsed > 0.0:
            accel = (speed[k] - memory[1]) / elapsed
            if not np.isnan(memory[2]):
                total += abs(accel - memory[2]) / elapsed
                counted += 1
        memory[0], memory[1], memory[2] = frame, speed[k], accel
    return total, counted
