"""The gap that an AV takes which has waited long before a line where it must give way.

SUMO's driver lets everybody go first who has the right of way over it, he who stands too: he may set off at
any time. Often he waits himself, until the gap is over. Here who stands has waived it, AVs agree to let one
in (V2V), and all others must be so far that they need not brake for it.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from cosim.geometry import Boxes, overlap
from cosim.road import Link, RoadMap, Rule
from cosim.simulation.backend import sumo
from cosim.simulation.eyes import Eyes
from cosim.simulation.foes import Foes
from cosim.simulation.lawful.inside import SPACING, Inside
from cosim.types import Floats

WITHIN = 200.0  # m before their lines, in which others are looked at
GENTLY = 1.2  # m/s2: who can stop before his line with less is not asked
SEEN = 0.5  # m behind its line, where others brake for it
FASTEST = 20.0  # m/s, limit of their roads: where they drive faster that is too near
SETS_OFF = 0.5, 2.0  # s until one moves, m/s2 with which it gains speed
GAINS = 2.0  # m/s2, with which those who drive are taken to gain speed, up to the limit
MARGIN = 1.5  # s between one and the next at a place that both pass
MATCHES = 1.5  # m/s2, with which who then follows on its lane may slow down
BRAKES = 25.0  # m before his line, where who gives way himself brakes
WAIVES = 2.0  # s for which who stands has stood
SLOWED = 1.2  # m/s2, with which who lets it in can still stop when it sets off
HORIZON = 5.0  # s until it can, in which those who let it in are asked
STOPS = (Rule.STOP, Rule.ALL_WAY_STOP)

Met = tuple[float, float, float]  # m behind the lines: own way clear; from where and up to where he is on it


class Gaps:
    """The gaps at the lines of `road`, seen with `eyes`; `inside` knows the ways through its junctions."""

    def __init__(self, road: RoadMap, inside: Inside, eyes: Eyes) -> None:
        self._road = road
        self._inside = inside
        self._eyes = eyes
        self._foes = Foes(road, WITHIN, eyes)

    def take(
        self, name: str, lane: str, via: str, lets: Callable[[str, float], bool | None]
    ) -> tuple[bool, list[str]]:
        """Whether `name`, which stands on `lane` before a line, can set off now over the lane `via` in the
        junction; and the AVs that have to let it in, now or soon.

        Args:
            lane: also one inside a junction, at whose end the net lets it wait; `via` does not matter then.
            lets: whether a vehicle, so many m before its line, lets others in; None: it sets off itself.
        """
        road, get = self._road, self._eyes.of(name)
        own = road.index.get(lane, -1)
        link, into = self._ahead(own, road.index.get(via, -1))
        if link < 0 or self._left_to_sumo(name, link):
            return False, []
        line = road.lanes[own].length - sumo.vehicle.getLanePosition(name)  # m
        mine = self._inside.through(name, into, 0.0)
        closed: list[tuple[float, float]] = []  # s from now: from when until when it cannot set off
        agreed: list[tuple[float, str, bool]] = []  # s: from when on, for whom who lets it in; is he slow
        first: dict[int, float] = {}  # lane -> m before its line, behind which nobody passes who stays there
        for before, other, number in self._by_distance(link, name):
            if before is None:
                return False, []
            theirs, speed = road.links[number], get.getSpeed(other)
            agrees = lets(other, before) if before > 0.0 else None
            stands = agrees is not None and sumo.vehicle.getWaitingTime(other) > WAIVES
            if before > first.get(theirs.origin, math.inf) and not _slows(theirs, before):
                continue
            met = self._meet(mine, other, number) if agrees or not stands else None
            if stands or (agrees and met is not None):
                first[theirs.origin] = min(before, first.get(theirs.origin, math.inf))
            if met is None:
                continue
            begin, end = self._shut(road.links[link], line, number, met, before, speed)
            if agrees:
                agreed.append((begin, other, speed**2 <= 2.0 * SLOWED * max(before - 1.0, 0.0)))
            elif end > 0.0:
                closed.append((begin, end))
        start = 0.0
        for begin, end in sorted(closed):
            if begin < start < end:
                start = end
        asked = [(other, slow) for begin, other, slow in agreed if begin < start]
        if start > HORIZON:
            return False, []
        return start == 0.0 and all(slow for _, slow in asked), [other for other, _ in asked]

    def brakes(self, name: str, lane: str, via: str, step: float, comes: Callable[[str], bool]) -> float:
        """m/s2 with which the drivers of those with the right of way would brake at most, if `name` went on
        from `lane`, on which it nears its line or waits behind it, over the lane `via`. SUMO's
        drivers stop their `minGap` before the place where the lanes meet.

        Args:
            lane: as of `take`.
            step: s of a simulation step.
            comes: whether a vehicle is one that can be asked.
        """
        road, get = self._road, self._eyes.of(name)
        own = road.index.get(lane, -1)
        link, into = self._ahead(own, road.index.get(via, -1))
        if link < 0 or not road.links[link].foes:
            return 0.0
        mine, hardest = None, 0.0
        away = road.lanes[own].length - get.getLanePosition(name)
        there = _time(away + SEEN, get.getSpeed(name), GAINS, FASTEST)  # s
        for other, number in self._foes.of(link, name):
            if road.links[number].rule in STOPS or not comes(other):  # who stops brakes anyway
                continue
            before, speed = self._before(other, number, get), get.getSpeed(other)
            if before is None or before <= 0.0 or speed**2 <= 2.0 * GENTLY * before:
                continue
            if mine is None:
                mine = self._inside.through(name, into, 0.0)
                mine[4] += 2.0 * (road.lanes[into].width - mine[4])  # both as wide as the lanes
            met = self._meet(mine, other, number)
            if met is not None:
                gap = max(before + met[1] - get.getMinGap(other) - there * speed, 0.1)
                hardest = max(hardest, (speed - get.getStopSpeed(other, speed, gap)) / step)
        return hardest

    # ---- inside ----

    def _ahead(self, own: int, via: int) -> tuple[int, int]:
        """The link over whose line, or from whose place to wait, one goes on from the lane `own`, and onto
        which lane; below 0 where there is none."""
        road = self._road
        if not road.waits_inside(own):
            return road.link_of.get((own, via), -1), via
        link = road.links_through[own][0]
        return link, road.lanes[own].successors[0]

    def _left_to_sumo(self, name: str, link: int) -> bool:
        """Whether there is a signal, or other rules than to give way; whether others drive too fast to be
        seen in time, or persons are at the junction, whom SUMO's driver looks for on its own way and beside
        it."""
        lanes, links = self._road.lanes, self._road.links
        if links[link].signal >= 0 or links[link].rule not in (Rule.YIELD, Rule.STOP):
            return True
        if any(lanes[links[foe].origin].speed_limit > FASTEST for foe in links[link].foes):
            return True
        return any(True for _ in self._inside.walkers(name, lanes[links[link].via].start, 0.0))

    def _by_distance(self, link: int, name: str) -> Iterator[tuple[float | None, str, int]]:
        """Those with the right of way over a link: m before their line (below 0: beyond it; None: not
        known), who, and by which link; the nearest first."""
        get = self._eyes.of(name)
        found = [
            (self._before(other, number, get), other, number) for other, number in self._foes.of(link, name)
        ]
        yield from sorted(found, key=lambda foe: -math.inf if foe[0] is None else foe[0])

    def _meet(self, mine: Floats, other: str, number: int) -> Met | None:
        """Where who drives `mine` ([5,k], of `Inside.through`) and `other` meet; None where they do not."""
        theirs = self._inside.through(other, self._road.links[number].via, 0.0)
        met = overlap(Boxes(*mine[:, :, None]), Boxes(*theirs[:, None, :]))  # [places, places]
        places, others = np.flatnonzero(met.any(1)), np.flatnonzero(met.any(0))
        if not len(places):
            return None
        return float(places[-1] + 1) * SPACING, float(others[0]) * SPACING, float(others[-1]) * SPACING

    def _shut(
        self, mine: Link, line: float, number: int, met: Met, before: float, speed: float
    ) -> tuple[float, float]:
        """s from now, from when until when one who is `line` m before its line cannot set off for who drives
        `speed` m/s `before` m before the line of the link `number`."""
        lanes, theirs = self._road.lanes, self._road.links[number]
        clear, reach, gone = met
        (wait, gains), turns = SETS_OFF, lanes[mine.via].speed_limit
        most = max(speed, lanes[theirs.origin].speed_limit)
        if before > 0.0 and theirs.rule in STOPS:
            there = before / max(speed, 0.1) + wait + _time(reach, 0.0, GAINS, most)
        elif _slows(theirs, before):
            there = _time(before - BRAKES, speed, GAINS, most)
        else:
            there = _time(before + reach, speed, GAINS, most)
        if theirs.target == mine.target:
            slower = max(most - min(math.sqrt(2.0 * gains * (line + clear)), turns), 0.0)  # m/s
            there -= slower**2 / (2.0 * MATCHES) / most
        passes = wait + _time(line + clear, 0.0, gains, turns)
        return there - passes - MARGIN, (before + gone) / max(speed, 1.0)

    def _before(self, name: str, number: int, get: Any) -> float | None:
        """m that a vehicle is before the line of the link `number`; below 0: beyond it. None: not known.

        `get`: of `Eyes.of`.
        """
        road = self._road
        lane, at = road.index.get(get.getLaneID(name), -1), get.getLanePosition(name)
        if lane < 0:
            return None
        beyond = 0.0
        for inside in road.inside[number]:
            if inside == lane:
                return -float(beyond + at)
            beyond += road.lanes[inside].length
        away = float(road.lanes[lane].length - at)
        if get is not sumo.vehicle and road.lanes[lane].id != sumo.vehicle.getLaneID(name):
            return self._straight(lane, away, number)  # the links ahead of where it is are not the ones
        while road.lanes[lane].internal:  # `getNextLinks` begins at the end of the lane that it comes out on
            lane = next(iter(road.lanes[lane].successors), -1)
            if lane < 0:
                return None
            away += road.lanes[lane].length
        for following, _, _, _, via, *_, length in get.getNextLinks(name):
            if via and road.index.get(via, -1) == road.links[number].via:
                return away
            away += float(length + sumo.lane.getLength(following))
        return None

    def _straight(self, lane: int, away: float, number: int) -> float | None:
        """`_before` of one that is `away` m before the end of `lane` and drives on straight."""
        following, length = self._road.straight_on
        while away < WITHIN and (lane := int(following[lane])) >= 0:
            if lane == self._road.links[number].via:
                return away
            away += float(length[lane])
        return None


def _slows(link: Link, before: float) -> bool:
    """Whether who is so many m before the line of `link` brakes there, to give way, without stopping."""
    return before > 0.0 and bool(link.foes) and link.rule not in STOPS


def _time(way: float, speed: float, gains: float, most: float) -> float:
    """s for `way` m from `speed` m/s on, gaining `gains` m/s2 up to `most` m/s; 0 for none."""
    way, until = max(way, 0.0), (most**2 - speed**2) / (2.0 * gains)
    if way <= until:
        return (math.sqrt(speed**2 + 2.0 * gains * way) - speed) / gains
    return (most - speed) / gains + (way - until) / most
