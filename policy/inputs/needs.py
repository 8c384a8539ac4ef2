"""Vehicles that need something of an AV: they signal a change onto its lane, or wait for it at a line.

No vehicle is marked: each need follows from the road map and from what the AV knows, on any network.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cosim.road import LanePath, RoadMap
from cosim.types import LENGTH, SPEED, History, PolicyContext
from policy.inputs.conflict import along, beside

STANDING = 1.0  # m/s: a slower vehicle waits
FORGET = 2.0  # s of waiting forgotten in a second of driving
LINE_RANGE = 12.0  # m before its line, within which a vehicle waits for those with priority
AHEAD_RANGE = 300.0  # m on the AV's way, within which junctions count


class Need(NamedTuple):
    """A vehicle's need of one AV."""

    vehicle: str
    crossing: bool  # it waits at a line where it gives way to the AV; else it signals onto the AV's lane
    gap: float  # m from the AV's front to the vehicle's rear, or (crossing) to the AV's own line
    between: int  # vehicles on the AV's way inside this gap
    speed: float  # m/s, of the vehicle
    remaining: float  # m, left to the vehicle before its line, or the end of its lane (inf: it does not end)
    waited: float  # s (`Waiting`)
    link: int = -1  # (crossing) the AV's way over the line: `RoadMap.links`


class Waiting:
    """The seconds that each known vehicle has stood: counted below `STANDING`, forgotten while it drives."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[float, float]] = {}  # vehicle -> s that it has waited, at this time

    def update(self, vehicle: str, speed: float, time: float) -> float:
        """s that the vehicle has waited at `time` s; a vehicle out of sight keeps its count."""
        waited, last = self._known.get(vehicle, (0.0, time))
        past = time - last
        waited = waited + past if speed < STANDING else max(waited - FORGET * past, 0.0)
        if speed < STANDING or waited > 0.0:
            self._known[vehicle] = waited, time
        else:
            self._known.pop(vehicle, None)
        return waited

    def tell(self) -> dict[str, tuple[float, float]]:
        """A message to other AVs: vehicle -> s that it has waited, and when that was known (s)."""
        return dict(self._known)

    def hear(self, told: Mapping[str, tuple[float, float]], time: float) -> None:
        """Take over longer counts from a message, as if each vehicle had driven since."""
        for vehicle, (waited, known) in told.items():
            waited -= FORGET * (time - known)
            if waited > self._known.get(vehicle, (0.0, time))[0]:
                self._known[vehicle] = waited, time


class Needs:
    """The needs of each AV; remembers for how long vehicles have waited.

    AVs that share their perception share this memory too. Otherwise an AV tells it to those that hear its
    intentions (`History.hears`).
    """

    def __init__(self, context: PolicyContext) -> None:
        self._road, self._pooled = context.road, context.pooled
        self._waiting: dict[str, Waiting] = {}
        self._yielding = _lanes_that_yield_to(context.road)

    def find(self, histories: Mapping[str, History]) -> dict[str, list[Need]]:
        """AV -> the needs that it can serve, nearest first; AVs without a need are left out."""
        found = {}
        told = {av: waiting.tell() for av, waiting in self._waiting.items()}
        for av, history in histories.items():
            waiting = self._waiting.setdefault("" if self._pooled else av, Waiting())
            for other in history.hears or ():  # in any order: the longest count remains
                waiting.hear(told.get(other, {}), history.time)
            needs = self._of(history, waiting)
            if needs:
                found[av] = sorted(needs, key=lambda need: need.gap)
        return found

    # ---- inside ----

    def _of(self, history: History, waiting: Waiting) -> list[Need]:
        own = history.route.paths[1]
        if own is None:
            return []
        lines = self._lines_ahead(history, own)
        needs = []
        for row in np.flatnonzero(history.valid[-1] & (history.lane >= 0)).tolist()[1:]:
            lane, speed = int(history.lane[row]), float(history.kinematics[-1, row, SPEED])
            waited = waiting.update(history.ids[row], speed, history.time)
            need = None
            if lane in lines:
                need = self._crossing(history, own, row, waited, *lines[lane])
            elif len(history.indicator) and history.indicator[row]:
                need = self._merging(history, own, row, waited)
            if need is not None:
                needs.append(need)
        return needs

    def _merging(self, history: History, own: LanePath, row: int, waited: float) -> Need | None:
        """The need of a vehicle that signals a lane change, if onto the AV's path."""
        theirs = self._road.path(int(history.lane[row]))
        meet = beside(self._road, own, theirs)
        if meet is None or (history.indicator[row] > 0) != meet[2] or theirs.lanes[0] in own.lanes:
            return None
        mine, other, _ = meet
        newest = history.kinematics[-1, row]
        place = float(history.lane_position[row]) * theirs.scale  # m, front bumper
        half = 0.5 * float(history.kinematics[-1, 0, LENGTH])  # m, of the AV
        gap = (mine - history.route.arc - half) - (other - place) - float(newest[LENGTH])
        between = self._between(history, own, gap)
        left = theirs.length - place if theirs.dead_end else np.inf
        return Need(history.ids[row], False, gap, between, float(newest[SPEED]), left, waited)

    def _crossing(
        self, history: History, own: LanePath, row: int, waited: float, line: float, link: int
    ) -> Need | None:
        """The need of a vehicle that gives way to the AV, whose own line is `line` m ahead."""
        remaining = self._road.lanes[int(history.lane[row])].length - float(history.lane_position[row])
        if remaining > LINE_RANGE:
            return None
        speed = float(history.kinematics[-1, row, SPEED])
        between = self._between(history, own, line)
        return Need(history.ids[row], True, line, between, speed, remaining, waited, link=link)

    @staticmethod
    def _between(history: History, own: LanePath, gap: float) -> int:
        """Vehicles on the AV's way within `gap` m of its front."""
        half = 0.5 * float(history.kinematics[-1, 0, LENGTH])  # m, of the AV
        ahead = along(history, own)[:, 0]
        return int(((ahead > 0.0) & (ahead < gap + half)).sum())

    def _lines_ahead(self, history: History, own: LanePath) -> dict[int, tuple[float, int]]:
        """Lanes whose vehicles give way to this AV -> m to the AV's line there, and its link over it."""
        front = history.route.arc + 0.5 * float(history.kinematics[-1, 0, LENGTH])
        found: dict[int, tuple[float, int]] = {}
        for (lane, following), start in zip(pairwise(own.lanes), own.lane_start[1:].tolist(), strict=True):
            line = start - front
            if line > AHEAD_RANGE:
                break
            link = self._road.link_of.get((lane, following))
            if link is not None and line > 0.0:
                for origin in self._yielding.get(link, ()):
                    found.setdefault(origin, (line, link))
        return found


def _lanes_that_yield_to(road: RoadMap) -> dict[int, frozenset[int]]:
    """Link -> the lanes from which links without a signal give way to it."""
    found: dict[int, set[int]] = {}
    for link in road.links:
        if link.signal < 0:
            for foe in link.foes:
                found.setdefault(foe, set()).add(link.origin)
    return {foe: frozenset(lanes) for foe, lanes in found.items()}
