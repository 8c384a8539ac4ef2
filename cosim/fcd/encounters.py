"""Single conflicts behind the figures: the two vehicles, time, place and severity."""

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from cosim.geometry import (
    Boxes,
    boxes,
    deceleration_to_avoid_crash,
    post_encroachment_time,
    time_to_collision,
)
from cosim.metrics.context import CRITICAL, watched
from cosim.metrics.near_misses import MIN_PAUSE
from cosim.metrics.post_encroachment import MAX_PET
from cosim.road import RoadMap
from cosim.types import Snapshot

MAX_LANES_AHEAD = 3  # followed to find out whether two paths merge
ALIGNED, ONCOMING = math.radians(15.0), math.radians(135.0)  # as in PET and DRAC


@dataclass(slots=True)
class Encounter:
    """Two vehicles during a critical time to collision. Values at its minimum, except the DRAC."""

    begin_s: float
    end_s: float
    ego: str  # a watched vehicle
    foe: str
    min_ttc_s: float
    at_s: float  # time of the smallest time to collision
    x_m: float  # the ego's centre at that time
    y_m: float
    lane: str  # the ego's at that time; "" off every lane
    ego_speed_mps: float
    foe_speed_mps: float
    max_drac_mps2: float  # largest of the encounter; 0 if the vehicles only overlapped
    type: str = ""  # following, lane change, merging, crossing or oncoming, at that time
    lane_jump: bool = False  # a vehicle had just jumped to another lane (not in headline figures)
    pet_s: float = math.nan  # post-encroachment time of crossing or merging paths; NaN: above 5 s


@dataclass(slots=True)
class _Followed:
    """An encounter with the trajectories of both vehicles from its begin, for the PET."""

    encounter: Encounter
    sizes: tuple[tuple[float, float], ...]  # length and width of ego and foe, m
    frames: list[tuple[tuple[float, ...], ...]] = field(default_factory=list)  # [t][2] x, y, heading, speed

    def add(self, s: Snapshot) -> None:
        rows = (s.row.get(self.encounter.ego), s.row.get(self.encounter.foe))
        absent = (math.nan,) * 4
        self.frames.append(
            tuple(absent if i is None else (s.x[i], s.y[i], s.heading[i], s.speed[i]) for i in rows)
        )

    def finish(self, interval: float) -> Encounter:
        """The encounter with its PET; `interval` s between frames."""
        ways = np.array(self.frames, np.float64).transpose(1, 2, 0)  # [2,4,t]
        ego, foe = (
            Boxes(x, y, heading, length, width, speed)
            for (x, y, heading, speed), (length, width) in zip(ways, self.sizes, strict=True)
        )
        pet = post_encroachment_time(ego, foe, interval, MAX_PET)
        self.encounter.pet_s = pet if math.isfinite(pet) else math.nan
        return self.encounter


class Encounters:
    """Finds encounters in frames: pairs of a watched and any other vehicle with a time to collision below
    `critical` s (oriented boxes at constant velocity, as in `min_ttc_s`)."""

    def __init__(self, road: RoadMap, critical: float = CRITICAL) -> None:
        self._road, self._critical = road, critical
        self._open: dict[tuple[str, str], _Followed] = {}
        self._late: list[_Followed] = []  # ended, still followed for the PET
        self._closed: list[Encounter] = []
        self._interval, self._time = math.nan, math.nan  # s: between frames, and of the newest frame

    def add(self, snapshot: Snapshot, jumped: Collection[str] = ()) -> None:
        """Add the next frame; `jumped`: vehicles that have just jumped to another lane."""
        s = snapshot
        self._jumped = jumped
        self._interval, self._time = snapshot.time - self._time, snapshot.time
        rows = np.flatnonzero(watched(s))
        if len(rows) and s.n > 1:
            mine = boxes(s, rows)
            columns = type(mine)(*(np.asarray(value)[:, None] for value in mine))
            ttc = time_to_collision(columns, boxes(s), self._critical)  # [k,n] s
            for k, j in np.argwhere(ttc < self._critical).tolist():
                self._update(s, int(rows[k]), j, float(ttc[k, j]))
        over = [pair for pair, f in self._open.items() if s.time - f.encounter.end_s > MIN_PAUSE + 1e-9]
        self._late += [self._open.pop(pair) for pair in over]
        for followed in (*self._open.values(), *self._late):
            followed.add(snapshot)
        gone = [f for f in self._late if s.time - f.encounter.end_s > MAX_PET + 1e-9]
        self._late = [f for f in self._late if f not in gone]
        self._closed += [f.finish(self._interval) for f in gone]

    def found(self) -> list[dict[str, Any]]:
        """All encounters so far as table rows, in the order of their begins."""
        rest = [f.finish(self._interval) for f in (*self._late, *self._open.values())]
        return [asdict(e) for e in sorted([*self._closed, *rest], key=lambda e: (e.begin_s, e.ego, e.foe))]

    def _update(self, s: Snapshot, i: int, j: int, ttc: float) -> None:
        """Open or update the encounter of the vehicles in rows `i` and `j`; `ttc` in s."""
        if i == j or not self._road.connected(int(s.place[i]), int(s.place[j])):
            return
        ego, foe = s.ids[i], s.ids[j]
        if (foe, ego) in self._open:  # both are watched: the pair is listed once
            return
        a, b = boxes(s, np.array([i])), boxes(s, np.array([j]))
        drac = float(np.squeeze(deceleration_to_avoid_crash(a, b))) if ttc > 0.0 else 0.0
        known = self._open.get((ego, foe))
        before = known.encounter if known else None
        hardest = max(drac if np.isfinite(drac) else 0.0, before.max_drac_mps2 if before else 0.0)
        if before is not None and before.min_ttc_s <= ttc:
            before.end_s, before.max_drac_mps2 = s.time, hardest
            return
        closest = Encounter(
            begin_s=before.begin_s if before else s.time,
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
            lane_jump=ego in self._jumped or foe in self._jumped,
            type=self._type(int(s.lane[i]), int(s.lane[j]), float(s.heading[i] - s.heading[j])),
        )
        if known is None:
            sizes = tuple((float(s.length[k]), float(s.width[k])) for k in (i, j))
            known = self._open[ego, foe] = _Followed(closest, sizes)
        known.encounter = closest

    def _type(self, a: int, b: int, turned: float) -> str:
        """Conflict type on lanes `a` and `b` (-1: off every lane), with headings `turned` rad apart."""
        turned = abs(math.remainder(turned, math.tau))
        if turned > ONCOMING:
            return "oncoming"
        if min(a, b) >= 0:
            mine, theirs = self._ahead(a), self._ahead(b)
            if a in theirs or b in mine:
                return "following"
            if edge_of(self._road, a) == edge_of(self._road, b) and turned <= ALIGNED:
                return "lane change"
            if mine & theirs:
                return "merging"
        return "following" if turned <= ALIGNED else "crossing"

    def _ahead(self, lane: int) -> set[int]:
        """The lane and its successors, as long as each has only one."""
        found = [lane]
        while len(found) <= MAX_LANES_AHEAD and len(onward := self._road.lanes[found[-1]].successors) == 1:
            found.append(onward[0])
        return set(found)


def edge_of(road: RoadMap, lane: int) -> str:
    """The edge of a lane from SUMO's lane name (the only source without a net)."""
    return road.lanes[lane].id.rpartition("_")[0]
