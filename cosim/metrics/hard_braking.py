"""Hard braking: how often vehicles began to brake harder than 3 m/s2, AVs and all."""

from __future__ import annotations

from cosim.metrics.context import MetricContext, rows_in_both
from cosim.types import Kind, Metric, Snapshot

THRESHOLD = 3.0  # m/s2, about 0.3 g: the usual bound of hard-braking events in naturalistic driving data


class HardBraking:
    """An event begins at a frame whose mean deceleration exceeds the threshold, unless one goes on."""

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._before = first
        self._braking: frozenset[str] = frozenset()
        self._all = self._av = 0
        self._any = first.n > 0
        self._any_av = bool((first.kind == Kind.AV).any())

    def add(self, snapshot: Snapshot) -> None:
        s, before = snapshot, self._before
        elapsed = s.time - before.time
        then, now = rows_in_both(before, s)
        self._before = s
        self._any = self._any or s.n > 0
        self._any_av = self._any_av or bool((s.kind == Kind.AV).any())
        if elapsed <= 0.0:
            return
        hard = now[(before.speed[then] - s.speed[now]) > THRESHOLD * elapsed]
        braking = frozenset(s.ids[row] for row in hard)
        begun = braking - self._braking
        self._all += len(begun)
        self._av += sum(s.kind[s.row[name]] == Kind.AV for name in begun)
        self._braking = braking

    def result(self) -> dict[str, Metric]:
        return {
            "hard_brakings": Metric(self._all if self._any else None, "events", "lower"),
            "hard_brakings_av": Metric(int(self._av) if self._any_av else None, "events", "lower"),
        }
