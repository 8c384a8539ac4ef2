"""Conflicts of AVs with persons: contact, critical time to collision, or short post-encroachment time."""

from collections import deque

import numpy as np

from cosim.geometry import EVERYWHERE, Boxes, boxes, time_to_collision
from cosim.geometry.kernels import encroachment
from cosim.metrics.context import AV, CRITICAL, PERSON, MetricContext, slow
from cosim.metrics.law import AvCounts
from cosim.metrics.post_encroachment import NEAR_MISS_PET
from cosim.types import Metric, Snapshot

SPEED_FACTOR = 2.0  # factor: bound of the last second's speeds relative to present speeds


class PersonConflicts(AvCounts):
    """Distinct pairs of an AV and a person (figures.md, Conflicts and comfort)."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        super().reset(first, context)
        self._interval = context.timing.frame  # s
        self._contact = context.road.contact
        self._frames: deque[Snapshot] = deque(maxlen=int(np.ceil(NEAR_MISS_PET / self._interval)) + 2)
        self._pairs: set[tuple[str, str]] = set()
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        super().add(snapshot)
        s = snapshot
        self._frames.append(s)
        if not slow(s.kind, s.speed, PERSON, np.inf) or not slow(s.kind, s.speed, AV, np.inf):
            return
        persons, avs = np.flatnonzero(s.kind == PERSON), np.flatnonzero(s.kind == AV)
        mine, theirs = boxes(s, avs), boxes(s, persons)
        columns = Boxes(*(np.asarray(v)[:, None] for v in mine))
        critical = time_to_collision(columns, theirs, np.inf) < CRITICAL  # [a,p], touching is 0
        # pairs further apart cannot have used the same place within the trail
        away = np.hypot(s.x[avs, None] - s.x[persons], s.y[avs, None] - s.y[persons])
        sizes = s.length[avs, None] + s.length[persons]
        near = away < sizes + SPEED_FACTOR * (s.speed[avs, None] + s.speed[persons] + 1.0) * NEAR_MISS_PET
        number, table = self._contact.numbers(s.place), self._contact.table
        touch = table[number[avs, None], number[persons]]
        for i, j in np.argwhere((critical | near) & touch).tolist():
            pair = s.ids[avs[i]], s.ids[persons[j]]
            if pair not in self._pairs and (critical[i, j] or self._encroached(pair) < NEAR_MISS_PET):
                self._pairs.add(pair)

    def result(self) -> dict[str, Metric]:
        return {"person_conflicts": self.count(len(self._pairs), "pairs")}

    def _encroached(self, pair: tuple[str, str]) -> float:
        """The pair's post-encroachment time at the newest frame, s; inf for none."""
        trail = np.full((len(self._frames), 2, 6), np.nan)
        sizes = np.zeros((2, 2))
        for k, frame in enumerate(self._frames):
            for n, name in enumerate(pair):
                if (row := frame.row.get(name)) is not None:
                    heading = frame.heading[row]
                    course = np.cos(heading), np.sin(heading), frame.speed[row], 0.0
                    trail[k, n] = frame.x[row], frame.y[row], *course
                    sizes[n] = frame.length[row], frame.width[row]
        both = np.ones(2, np.bool_)
        return float(encroachment(trail, len(trail) - 1, 2, sizes, both, self._interval, EVERYWHERE)[0])
