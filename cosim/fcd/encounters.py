"""Single conflicts behind the figures: who met whom, when, where, and how close it came."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cosim.geometry import boxes, deceleration_to_avoid_crash, time_to_collision
from cosim.metrics.context import watched
from cosim.metrics.time_to_collision import CRITICAL
from cosim.road import RoadMap
from cosim.types import Snapshot

APART = 1.0  # s without a critical frame: what follows is another encounter


@dataclass(slots=True)
class Encounter:
    """Two vehicles while their time to collision was critical; values at its smallest, but for the DRAC."""

    begin_s: float
    end_s: float
    ego: str  # a watched vehicle
    foe: str
    min_ttc_s: float
    at_s: float  # when that was
    x_m: float  # the ego's centre then
    y_m: float
    lane: str  # the ego's then; "" off every lane
    ego_speed_mps: float
    foe_speed_mps: float
    max_drac_mps2: float  # largest of the encounter; 0 where they only overlapped


class Encounters:
    """Frames in, encounters out: every pair of a watched vehicle with anybody whose time to collision fell
    below `critical` s (oriented boxes at constant velocity, as in `min_ttc_s`)."""

    def __init__(self, road: RoadMap, critical: float = CRITICAL) -> None:
        self._road, self._critical = road, critical
        self._open: dict[tuple[str, str], Encounter] = {}
        self._closed: list[Encounter] = []

    def add(self, snapshot: Snapshot) -> None:
        """The next frame."""
        s = snapshot
        rows = np.flatnonzero(watched(s))
        if len(rows) and s.n > 1:
            mine = boxes(s, rows)
            columns = type(mine)(*(np.asarray(value)[:, None] for value in mine))
            ttc = time_to_collision(columns, boxes(s), self._critical)  # [k,n] s
            for k, j in np.argwhere(ttc < self._critical).tolist():
                self._meet(s, int(rows[k]), j, float(ttc[k, j]))
        late = [pair for pair, e in self._open.items() if s.time - e.end_s > APART + 1e-9]
        self._closed += [self._open.pop(pair) for pair in late]

    def found(self) -> list[dict[str, Any]]:
        """All so far, in the order they began, as rows of a table."""
        every = [*self._closed, *self._open.values()]
        return [asdict(e) for e in sorted(every, key=lambda e: (e.begin_s, e.ego, e.foe))]

    def _meet(self, s: Snapshot, i: int, j: int, ttc: float) -> None:
        if i == j or not self._road.connected(int(s.lane[i]), int(s.lane[j])):
            return
        ego, foe = s.ids[i], s.ids[j]
        if (foe, ego) in self._open:  # both are watched: it is listed once
            return
        a, b = boxes(s, np.array([i])), boxes(s, np.array([j]))
        drac = float(np.squeeze(deceleration_to_avoid_crash(a, b))) if ttc > 0.0 else 0.0
        known = self._open.get((ego, foe))
        hardest = max(drac if np.isfinite(drac) else 0.0, known.max_drac_mps2 if known else 0.0)
        if known is not None and known.min_ttc_s <= ttc:
            known.end_s, known.max_drac_mps2 = s.time, hardest
            return
        self._open[ego, foe] = Encounter(
            begin_s=known.begin_s if known else s.time,
            end_s=s.time,
            ego=ego,
            foe=foe,
            min_ttc_s=ttc,
            at_s=s.time,
            x_m=float(s.x[i]),
            y_m=float(s.y[i]),
            lane=self._road.lanes[s.lane[i]].id if s.lane[i] >= 0 else "",
            ego_speed_mps=float(s.speed[i]),
            foe_speed_mps=float(s.speed[j]),
            max_drac_mps2=hardest,
        )
