"""Post-encroachment time: how soon after an AV or mission vehicle somebody crossed its path, or reversely."""

from __future__ import annotations

import numpy as np

from cosim.geometry import encroachment
from cosim.metrics.context import MetricContext, Slots, watched
from cosim.types import Metric, Snapshot

LONGEST = 5.0  # s, a later passage is no encounter any more (Allen et al. 1978 look at 1 to 5 s)


class PostEncroachment:
    """Smallest PET over crossing and merging encounters (`cosim.geometry.post_encroachment_time`)."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._interval = context.timing.frame  # s
        self._slots = Slots()
        self._frames = int(np.ceil(LONGEST / self._interval)) + 1
        self._trail = np.full((self._frames, 64, 5), np.nan)  # x m, y m, cos, sin, m/s
        self._sizes = np.zeros((64, 2))  # [slots,2] m
        self._watched = np.zeros(64, dtype=np.bool_)
        self._newest = -1
        self._smallest = np.inf
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        s = snapshot
        slot = self._slots.rows(s.ids)  # [n]
        if len(self._slots) > len(self._sizes):
            self._grow()
        self._newest = (self._newest + 1) % self._frames
        frame = self._trail[self._newest]
        frame[:] = np.nan
        frame[slot, 0], frame[slot, 1] = s.x, s.y
        frame[slot, 2], frame[slot, 3] = np.cos(s.heading), np.sin(s.heading)
        frame[slot, 4] = s.speed
        self._sizes[slot, 0], self._sizes[slot, 1] = s.length, s.width
        self._watched[slot] |= watched(s)
        found = encroachment(
            self._trail, self._newest, len(self._slots), self._sizes, self._watched, self._interval
        )
        self._smallest = min(self._smallest, found)

    def result(self) -> dict[str, Metric]:
        value = float(self._smallest) if self._smallest <= LONGEST else None
        return {"min_pet_s": Metric(value, "s", "higher")}

    def _grow(self) -> None:
        old, more = len(self._sizes), 2 * len(self._slots)
        self._trail = np.concatenate([self._trail, np.full((self._frames, more, 5), np.nan)], axis=1)
        self._sizes = np.concatenate([self._sizes, np.zeros((more, 2))])
        self._watched = np.concatenate([self._watched, np.zeros(old + more, dtype=np.bool_)])[: old + more]
