"""A scripted altruist: the AV best placed opens the gap for the mission vehicle, everybody else drives IDM.

It shows what altruism can gain without learning anything (docs/results/altruism.md) and is the yardstick
for the learned policies. AVs share what they know (V2V), so one guide is chosen for all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.road import LanePath, RoadMap
from cosim.types import IS_MISSION, Decision, History, MetaAction, PolicyContext
from policy.agents.idm import NO_MAPS

LANE = 3.2  # m, SUMO's lane width


@dataclass(frozen=True, slots=True)
class AltruistConfig:
    """When the guide yields and how much. Distances in m, speeds in m/s."""

    behind_min: float = -5.0  # a guide this far ahead of the mission vehicle can still fall back
    behind_max: float = 80.0  # further back its gap would come too late
    upstream_min: float = 60.0  # junctions: stopping at the line does not help, the gap opens upstream
    upstream_max: float = 260.0
    crawl: float = 2.0  # the guide waits upstream of a junction (on the grid: it stops)
    pace_below: float = 5.0  # beside an ending lane the guide drives this much slower than the other
    pace_min: float = 5.0  # and never slower than this
    clear: float = 10.0  # a free left lane: this much room ahead and behind,
    clear_time: float = 0.8  # s of a follower's way on top,
    max_closing: float = 3.0  # m/s that a follower there may be faster,
    closing_time: float = 3.0  # s of what the two close in on each other


@dataclass(frozen=True, slots=True)
class Need:
    """How one AV stands to the mission vehicle."""

    av: str
    behind: float  # m, how far behind the mission vehicle it will arrive where their ways meet
    crossing: bool  # their ways cross at a junction (else their lanes lie side by side)
    from_right: bool  # the mission vehicle's lane lies to the right
    speed: float  # m/s, of the mission vehicle


class Seen(NamedTuple):
    """The mission vehicle as one AV perceives it and tells the others."""

    lane: int  # index into RoadMap.lanes
    lane_position: float  # m, front bumper
    speed: float  # m/s


class AltruistRule:
    """Left if the left lane is free, else slower; at junctions slower, far upstream."""

    name = "altruist-rule"
    label = ""
    observation = NO_MAPS
    av_parameters: Mapping[str, str] = {}

    def __init__(self, config: AltruistConfig = AltruistConfig()) -> None:
        self._config = config

    def reset(self, context: PolicyContext) -> None:
        """A new episode: nobody has been served yet."""
        self._road = context.road
        self._served: set[str] = set()
        self._guide: dict[str, Need] = {}  # mission vehicle -> its guide

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """At most one command per mission vehicle: the guide's."""
        decisions: dict[str, Decision] = {}
        needs: dict[str, list[Need]] = {}
        for mission, seen in _missions(histories).items():
            for av, history in histories.items():
                need = None if mission in self._served else self._need(av, history, mission, seen)
                if need is not None:
                    needs.setdefault(mission, []).append(need)
        for mission, candidates in needs.items():
            if mission in self._served:
                continue
            guide = self._choose(mission, candidates)
            if guide is not None:
                self._guide[mission] = guide
                action = self._yield(guide, histories[guide.av])
                if action is not None:
                    decisions[guide.av] = Decision(action)
        return decisions

    def _need(self, av: str, history: History, mission: str, seen: Seen) -> Need | None:
        """Whether this AV's way meets the mission vehicle's, and where; None when it does not."""
        road, own, lane, speed = self._road, history.route.paths[1], seen.lane, seen.speed
        if own is None or lane < 0:
            return None
        theirs = road.path(lane)
        guide = self._guide.get(mission)
        place = seen.lane_position * theirs.scale  # m, their front bumper
        beside = _meeting(road, own, theirs)
        if beside is not None:
            if lane in own.lanes[:3] and guide is not None and guide.av == av:
                self._served.add(mission)  # it drives in our lane now
                return None
            mine, other, right = beside
            return Need(av, (mine - history.route.arc) - (other - place), False, right, speed)
        if not (np.isfinite(own.conflict) and _crosses_junction(road, theirs)):
            return None  # not our affair: we drive beside the lane they want
        if guide is not None and guide.crossing and (road.lanes[lane].internal or lane in own.lanes):
            self._served.add(mission)
            return None
        if _same_approach(road, own, theirs):
            return None
        behind = history.route.conflict_distance - max(theirs.conflict - place, 0.0)
        return Need(av, behind, True, False, speed)

    def _choose(self, mission: str, candidates: list[Need]) -> Need | None:
        c = self._config
        present = {n.av: n for n in candidates}
        before = self._guide.get(mission)
        chosen = None if before is None else present.get(before.av)
        if chosen is not None and (chosen.crossing or c.behind_min <= chosen.behind <= 2 * c.behind_max):
            return chosen
        fitting = [
            n
            for n in candidates
            if (
                c.upstream_min <= n.behind <= c.upstream_max
                if n.crossing
                else c.behind_min <= n.behind <= c.behind_max
            )
        ]
        return min(fitting, key=lambda n: n.behind, default=None)

    def _yield(self, need: Need, history: History) -> MetaAction | None:
        """What the guide does; None: it is so close to its leader that IDM shall drive."""
        c = self._config
        if need.crossing:
            wanted = c.crawl
        else:
            if need.from_right and self._left_is_free(history):
                return MetaAction.LANE_LEFT
            wanted = max(need.speed - c.pace_below, c.pace_min)
        if history.lane_changing:
            return MetaAction.IDLE
        if history.target_speed > wanted + 2.5:
            return MetaAction.DECELERATE  # in a tight platoon too: braking opens the gap to the leader
        return None if self._too_close(history) else MetaAction.IDLE

    def _left_is_free(self, history: History) -> bool:
        """Nobody there, nobody who would have to brake hard for us, nobody we would run into."""
        c, speed = self._config, history.ego_speed
        left = history.route.paths[0]
        if left is None or history.route.to_end(0) < 100.0 or history.lane_changing:
            return False
        for ahead, other in along(history, left, side=LANE):
            if ahead < 0.0 and other - speed > c.max_closing:
                return False  # a guide that has slowed down already stays in its lane
            behind = c.clear + other * c.clear_time + max(other - speed, 0.0) * c.closing_time
            front = c.clear + max(speed - other, 0.0) * c.closing_time
            if -behind < ahead < front:
                return False
        return True

    def _too_close(self, history: History) -> bool:
        """Closer to the leader than IDM's own wish (T = 0.8 s, d0 = 2 m, a = 3, b = 7 m/s2)."""
        own, speed = history.route.paths[1], history.ego_speed
        if own is None:
            return False
        for ahead, other in along(history, own):
            if ahead > 0.0:
                wish = 2.0 + 0.8 * speed + speed * max(speed - other, 0.0) / (2.0 * 21.0**0.5)
                if ahead - 5.0 < 1.1 * wish:
                    return True
        return False


def _missions(histories: Mapping[str, History]) -> dict[str, Seen]:
    """Every mission vehicle that any AV perceives (V2V: not everybody is near enough to)."""
    found: dict[str, Seen] = {}
    for history in histories.values():
        for r in np.flatnonzero(history.valid[-1] & (history.kinematics[-1, :, IS_MISSION] > 0.5)):
            speed = float(history.kinematics[-1, r, 2])
            found[history.ids[r]] = Seen(int(history.lane[r]), float(history.lane_position[r]), speed)
    return found


def along(history: History, path: LanePath, side: float = 0.0) -> list[tuple[float, float]]:
    """Vehicles on the path's next lanes, or behind on its course: m ahead of the ego (centres), m/s.

    Upstream a lane has other names, so behind it is the place that counts: `side` m to the left.
    """
    newest = history.kinematics[-1]
    return [
        (float(newest[r, 0]), float(newest[r, 2]))
        for r in np.flatnonzero(history.valid[-1])[1:]
        if int(history.lane[r]) in path.lanes[:3]
        or (newest[r, 0] < 0.0 and abs(newest[r, 1] - side) < LANE / 2.0)
    ]


def _crosses_junction(road: RoadMap, path: LanePath) -> bool:
    """Whether the conflict zone that the path meets lies inside a junction."""
    return any(road.lanes[i].internal and any(i in zone.lanes for zone in road.zones) for i in path.lanes)


def _same_approach(road: RoadMap, own: LanePath, theirs: LanePath) -> bool:
    """Whether both come along the same edge, lanes apart."""
    edges = {road.lanes[i].edge for i in own.lanes if not road.lanes[i].internal}
    return road.lanes[theirs.lanes[0]].edge in edges


def _meeting(road: RoadMap, own: LanePath, theirs: LanePath) -> tuple[float, float, bool] | None:
    """Where their lane comes to lie beside ours: arc on our path, arc on theirs, and whether on our right."""
    place = {lane: float(start) for lane, start in zip(own.lanes, own.lane_start, strict=True)}
    for lane, start in zip(theirs.lanes, theirs.lane_start, strict=True):
        left, right = road.lanes[lane].left, road.lanes[lane].right
        if left in place:
            return place[left], float(start), True
        if right in place:
            return place[right], float(start), False
    return None
