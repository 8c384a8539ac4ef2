"""Distance driven (DT of both papers): of all vehicles, of AVs, of HVs and of the mission vehicle."""

from __future__ import annotations

import numpy as np

from cosim.metrics.context import MetricContext, Slots, rows_in_both
from cosim.types import Bools, Floats, Kind, Metric, Snapshot


class Distance:
    """Mean over vehicles of the metres driven in the counted time (contract.md, Episode).

    The vehicles are those on the road at the first frame, so that a policy cannot change whom it is judged
    by; a vehicle that left keeps its distance. On a road that starts empty (a foreign scenario without
    warm-up) they are all that ever appeared. The mission vehicle counts whenever it appears.
    """

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._slots = Slots()
        self._driven: Floats = np.zeros(64)  # [slots] m
        self._is_av: Bools = np.zeros(64, dtype=np.bool_)
        self._is_mission: Bools = np.zeros(64, dtype=np.bool_)
        self._before = first
        self._started = first.n
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        s, before = snapshot, self._before
        slot = self._slots.rows(s.ids)  # [n]
        if len(self._slots) > len(self._driven):
            self._grow()
        then, now = rows_in_both(before, s)
        # trapezoid of the speeds: positions would count a teleport's jump as driven
        self._driven[slot[now]] += 0.5 * (before.speed[then] + s.speed[now]) * (s.time - before.time)
        self._is_av[slot] = s.kind == Kind.AV
        self._is_mission[slot] |= s.mission
        self._before = s

    def result(self) -> dict[str, Metric]:
        seen = len(self._slots)
        counted = np.arange(seen) < (self._started or seen)
        driven, av, mission = self._driven[:seen], self._is_av[:seen], self._is_mission[:seen]
        return {
            "dt_mean_m": _mean(driven[counted], "higher"),
            "dt_av_m": _mean(driven[counted & av], "higher"),
            "dt_hv_m": _mean(driven[counted & ~av], "higher"),
            "dt_mission_m": _mean(driven[mission], "higher"),
        }

    def _grow(self) -> None:
        more = 2 * len(self._slots)
        self._driven = np.concatenate([self._driven, np.zeros(more)])
        self._is_av = np.concatenate([self._is_av, np.zeros(more, dtype=np.bool_)])
        self._is_mission = np.concatenate([self._is_mission, np.zeros(more, dtype=np.bool_)])


def _mean(values: Floats, better: str) -> Metric:
    return Metric(float(values.mean()) if len(values) else None, "m", better)
