"""Jerk: the mean absolute rate of change of the AVs' acceleration, a measure of comfort."""

from __future__ import annotations

import numpy as np

from cosim.metrics.context import MetricContext, Slots
from cosim.types import Floats, Kind, Metric, Snapshot


class Jerk:
    """Second difference of the speeds of three frames in a row, mean over AVs and time."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._slots = Slots()
        self._speed: Floats = np.full(64, np.nan)  # [slots] m/s at the frame before, NaN while absent
        self._accel: Floats = np.full(64, np.nan)  # [slots] m/s2, mean up to the frame before
        self._time = first.time
        self._sum = 0.0  # m/s3
        self._counted = 0
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        elapsed = snapshot.time - self._time
        self._time = snapshot.time
        av = np.flatnonzero(snapshot.kind == Kind.AV)
        slot = self._slots.rows(snapshot.ids)[av]
        if len(self._slots) > len(self._speed):
            more = np.full(2 * len(self._slots), np.nan)
            self._speed = np.concatenate([self._speed, more])
            self._accel = np.concatenate([self._accel, more])
        speed = snapshot.speed[av]
        fresh_speed, fresh_accel = np.full_like(self._speed, np.nan), np.full_like(self._accel, np.nan)
        fresh_speed[slot] = speed
        if elapsed > 0.0:
            accel = (speed - self._speed[slot]) / elapsed
            jerk = np.abs(accel - self._accel[slot]) / elapsed  # [AVs] m/s3, NaN before a third frame
            known = jerk == jerk
            self._sum += float(jerk[known].sum())
            self._counted += int(known.sum())
            fresh_accel[slot] = accel
        self._speed, self._accel = fresh_speed, fresh_accel

    def result(self) -> dict[str, Metric]:
        mean = self._sum / self._counted if self._counted else None
        return {"mean_abs_jerk_mps3": Metric(mean, "m/s3", "lower")}
