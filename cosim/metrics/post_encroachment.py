"""Post-encroachment time: the smallest time between an AV's (or mission vehicle's) and another's passage;
and the near-misses of all vehicles by PET."""

import numpy as np

from cosim.geometry.kernels import encroachment, record
from cosim.metrics.context import MetricContext, watched
from cosim.metrics.near_misses import NearMisses
from cosim.metrics.slots import Slots, grown
from cosim.types import Ints, Metric, Snapshot

MAX_PET = 5.0  # s, limit of an encounter (Allen et al. 1978 use 1 to 5 s)
NEAR_MISS_PET = 1.0  # s


class PostEncroachment:
    """Smallest PET over crossing and merging encounters (`cosim.geometry.post_encroachment_time`)."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._interval = context.timing.frame  # s
        self._contact = context.road.contact
        self._guessed = context.mission_guessed
        self._slots = Slots()
        self._frames = int(np.ceil(MAX_PET / self._interval)) + 1
        self._trail = np.full((self._frames, 64, 6), np.nan)  # x m, y m, cos, sin, m/s, road
        self._lanes = np.full((self._frames, 64), -1)  # [frames,slots] as in `Snapshot.lane`
        self._sizes = np.zeros((64, 2))  # [slots,2] m
        self._watched = np.zeros(64, dtype=np.bool_)
        self._newest = -1
        self._known: Ints | None = None
        self._smallest = np.inf
        self.near_misses = NearMisses("pet")
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        s = snapshot
        if len(self._slots) > 2 * s.n + 64:
            self._drop_absent()
        slot = self._slots.rows(s.ids)  # [n]
        self._sizes = grown(self._sizes, len(self._slots), 0.0)
        self._watched = grown(self._watched, len(self._slots), False)
        self._trail = grown(self._trail, len(self._slots), np.nan, axis=1)
        self._lanes = grown(self._lanes, len(self._slots), -1, axis=1)
        self._newest = (self._newest + 1) % self._frames
        number = self._contact.numbers(s.place)
        record(self._trail, self._newest, slot, s.x, s.y, s.heading, s.speed, number)
        if slot is not self._known:  # a vehicle came or left
            self._sizes[slot, 0], self._sizes[slot, 1] = s.length, s.width
            self._known = slot
        self._watched[slot] |= watched(s, self._guessed)
        vehicles = len(self._slots), self._sizes, self._watched
        ring = self._trail, self._newest, *vehicles, self._interval, self._contact.table
        smallest, pairs = encroachment(*ring, NEAR_MISS_PET)
        self._smallest = min(self._smallest, smallest)
        self._lanes[self._newest] = -1
        self._lanes[self._newest, slot] = s.lane
        self.near_misses.add(s, self._met(s, slot, pairs))

    def _met(self, s: Snapshot, slot: Ints, pairs: Ints) -> Ints:
        """[q,2] rows of the `pairs` [p,2] of slots with both on the road and never on one lane in the whole
        trail. Pairs on one lane follow each other, or diverge, in a bend."""
        row = np.full(len(self._slots), -1)
        row[slot] = np.arange(s.n)
        kept = [
            (a, b)
            for a, b in pairs.tolist()
            if row[a] >= 0 and not np.isin(self._lanes[:, b][self._lanes[:, b] >= 0], self._lanes[:, a]).any()
        ]
        return row[np.array(kept, np.int64).reshape(-1, 2)]

    def _drop_absent(self) -> None:
        """Free the slots of absent vehicles: a frame's cost grows with the number of slots."""
        kept = np.flatnonzero(~np.isnan(self._trail[:, : len(self._slots), 0]).all(0))
        self._slots.keep(kept)
        self._trail, self._lanes = self._trail[:, kept], self._lanes[:, kept]
        self._sizes, self._watched = self._sizes[kept], self._watched[kept]
        self._known = None

    def result(self) -> dict[str, Metric]:
        value = float(self._smallest) if self._smallest <= MAX_PET else None
        return {"min_pet_s": Metric(value, "s", "higher"), **self.near_misses.result()}
