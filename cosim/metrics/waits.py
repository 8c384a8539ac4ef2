"""Waits: longest and squared waiting times of vehicles; squares weight long waits more."""

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.metrics.context import MetricContext
from cosim.metrics.slots import grown
from cosim.types import Bools, Floats, Ints, Metric, Snapshot

WAITING_SPEED = 1.0  # m/s: a slower vehicle is waiting
FORGIVEN_PER_S = 2.0  # s of a wait removed per second of driving


class Waits:
    """Of all vehicles due to depart, including waits for insertion (figures.md, Everybody)."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._everybody = context.everybody
        # [slots,2] s, present wait; s2, sum of squared waits
        self._tally: Floats = np.zeros((64, 2))
        self._time, self._longest = first.time, 0.0
        self._everybody.of(first)

    def add(self, snapshot: Snapshot) -> None:
        s, everybody = snapshot.vehicles, self._everybody
        slots = everybody.of(snapshot)
        self._tally = grown(self._tally, len(everybody), 0.0)
        elapsed, self._time = snapshot.time - self._time, snapshot.time
        for vehicle in snapshot.events.departed:
            if (slot := everybody.number(vehicle)) >= 0:
                self._tally[slot] = everybody.entry[slot], everybody.entry[slot] ** 2
        planned = np.zeros(s.n, np.bool_)  # at a scheduled stop
        for vehicle in snapshot.events.stopped:
            if (row := s.row.get(vehicle)) is not None:
                planned[row] = True
        self._longest = max(self._longest, _wait(s.speed, planned, slots, self._tally, elapsed))

    def result(self) -> dict[str, Metric]:
        everybody = self._everybody
        waited, squared = self._tally[: len(everybody)].T
        rest, outside = everybody.rest, everybody.waiting[0]
        squares = np.concatenate([squared + (waited + rest) ** 2 - waited**2, outside**2])
        ends = np.concatenate([(waited + rest)[rest > 0.0], everybody.entry, outside])
        known = len(squares) > 0 and not np.isnan(squares).any()
        return {
            "longest_wait_s": Metric(float(ends.max(initial=self._longest)) if known else None, "s", "lower"),
            "mean_squared_wait_s2": Metric(float(squares.mean()) if known else None, "s2", "lower"),
        }


@compiled
def _wait(speed: Floats, planned: Bools, slots: Ints, tally: Floats, elapsed: float) -> float:
    """Update every vehicle's wait by `elapsed` s; returns the longest present wait (s)."""
    longest = 0.0
    for k in range(len(slots)):
        row = tally[slots[k]]
        if speed[k] < WAITING_SPEED and not planned[k]:
            row[1] += elapsed * (2.0 * row[0] + elapsed)
            row[0] += elapsed
            longest = max(longest, row[0])
        else:
            row[0] = max(row[0] - FORGIVEN_PER_S * elapsed, 0.0)
    return longest
