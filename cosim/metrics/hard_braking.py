"""Hard braking: beginnings of braking harder than 3 m/s2, of AVs and of all vehicles."""

import numpy as np

from cosim.metrics.context import MetricContext
from cosim.types import Kind, Metric, Snapshot

THRESHOLD = 3.0  # m/s2, about 0.3 g: the usual bound of hard-braking events in naturalistic driving data


class HardBraking:
    """An event begins at a frame with mean deceleration above the threshold, unless another is in progress.
    The sudden stop of a wreck is no event."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._time = first.time
        first = first.vehicles
        self._speeds = dict(zip(first.ids, first.speed.tolist(), strict=True))  # m/s in the frame before
        self._braking: frozenset[str] = frozenset()
        self._wrecks = set(first.events.wrecked)
        self._all = self._av = 0
        self._kinds = set(first.kind.tolist())  # of all vehicles seen so far

    def add(self, snapshot: Snapshot) -> None:
        s, before = snapshot.vehicles, self._speeds
        self._wrecks.update(s.events.wrecked)
        change = THRESHOLD * (s.time - self._time)  # m/s
        self._time = s.time
        self._speeds = dict(zip(s.ids, s.speed.tolist(), strict=True))
        self._kinds.update(s.kind.tolist())
        if change <= 0.0:
            return
        was = np.fromiter(map(before.get, s.ids, self._speeds.values()), np.float64, s.n)
        braking = frozenset(s.ids[k] for k in np.flatnonzero(was - s.speed > change))
        begun = braking - self._braking - self._wrecks
        self._all += len(begun)
        self._av += sum(s.kind[s.row[name]] == Kind.AV for name in begun)
        self._braking = braking

    def result(self) -> dict[str, Metric]:
        return {
            "hard_brakings": Metric(self._all if self._kinds else None, "events", "lower"),
            "hard_brakings_av": Metric(int(self._av) if Kind.AV in self._kinds else None, "events", "lower"),
        }
