"""Watches, in every simulation step, for AVs that pass a stop line: what only a step of 0.1 s can see.

An AV is looked at in every step only where it may be within `NEAR` m of a line that matters (a signal, a stop
sign, somebody with the right of way); further away the look is put off to the step in which it could at the
earliest be there. Signals are read when SUMO says that they switch; in every step where others switch them.
"""

import heapq
import math
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from itertools import chain
from typing import NamedTuple

from cosim.road import RoadMap, Rule
from cosim.simulation.backend import sumo
from cosim.simulation.foes import Foes
from cosim.types import Entry

LAST = 10.0  # m before the line over which the least speed is taken (docs/reference/figures.md, The law)
FOES_WITHIN = 100.0  # m before its own line, within which a vehicle with the right of way counts
NEAR = LAST + 2.0  # m
HARDEST = 4.0  # m/s2: no AV gains speed faster
STANDING = 0.05  # m/s: slower than that in the last 10 m makes no difference
LONGEST = 100  # steps until the next look, for whoever SUMO puts elsewhere (teleports)
HOPS = 8  # lanes that one step may lead across
EPSILON = 1e-6


class Passed(NamedTuple):
    """A stop line passed, or the place behind it where the net lets one wait (`inside`): its link, and m from
    there to the start of the lane the AV is on now."""

    link: int
    beyond: float
    inside: bool


@dataclass(slots=True)
class Watched:
    """What is known of one AV."""

    lane: int = -1  # at the last look
    near: bool = False  # to a line, then
    trail: deque[tuple[float, float]] = field(default_factory=deque)  # (odometer m, speed m/s) near a line


@dataclass(slots=True)
class Light:
    """One traffic light: its state, and what was marked when each of its links turned yellow."""

    state: str
    yellow: dict[int, tuple[float, dict[str, tuple[float, float]]]] = field(default_factory=dict)


class EntryWatcher:
    """Yields an `Entry` for every AV that passes a stop line; `step` is the simulation step in s.

    `shared`: whether other programs switch signals too.
    """

    def __init__(self, road: RoadMap, step: float, shared: bool = False) -> None:
        self._road = road
        self._foes = Foes(road, FOES_WITHIN)
        self._shared = shared
        self._step = step
        self._matters = [
            link.signal >= 0 or bool(link.foes) or link.rule in (Rule.STOP, Rule.ALL_WAY_STOP)
            for link in road.links
        ]
        self._lengths = [lane.length for lane in road.lanes]  # [l] m
        self.needed = any(self._matters)
        get = partial(sumo.getter, "vehicle")
        self._lane_of, self._position_of, self._odometer_of = map(get, ("LaneID", "LanePosition", "Distance"))
        self._speed_of, self._accel_of = map(get, ("Speed", "Acceleration"))
        self.reset()

    def reset(self) -> None:
        """A new episode is loaded."""
        self._count = 0
        self._avs: dict[str, Watched] = {}
        self._due: defaultdict[int, list[str]] = defaultdict(list)  # step -> who is looked at in it
        self._lights: dict[str, Light] = {}
        self._switches: list[tuple[float, str]] = []  # (s, light), a heap
        if self.needed:
            for light in dict.fromkeys(name for name, _ in self._road.signals):
                state = sumo.trafficlight.getRedYellowGreenState(light)
                self._lights[light] = Light(state)
                heapq.heappush(self._switches, (-math.inf, light))

    def step(self, now: float, departed: Iterable[str]) -> tuple[Entry, ...]:
        """After a step that ended at `now` (s); `departed`: AVs inserted in it."""
        if not self.needed:
            return ()
        self._count += 1
        began = now - self._step
        if self._switches and self._switches[0][0] <= began + EPSILON:
            self._switch(began)
        for name in departed:
            self._avs[name] = Watched()
            self._due[self._count].append(name)
        due = self._due.pop(self._count, None)
        return tuple(chain.from_iterable(self._look(name, now) for name in due)) if due else ()

    # ---- inside ----

    def _look(self, name: str, now: float) -> Sequence[Entry]:
        """Look at one AV, and say when next; its entries."""
        av = self._avs[name]
        try:
            lane = self._road.index.get(self._lane_of(name), -1)
        except sumo.TraCIException:  # it left the road
            del self._avs[name]
            return ()
        before, av.lane = av.lane, lane
        if lane < 0:  # teleporting
            av.near = False
            self._due[self._count + 1].append(name)
            return ()
        position, speed = self._position_of(name), self._speed_of(name)
        entries: Sequence[Entry] = ()
        if lane != before and av.near:
            lines = self._passed(before, lane)
            entries = [self._entry(name, av, passed, position, speed, now) for passed in lines]
        away = self._lengths[lane] - position + self._free[lane]  # m to the next line
        av.near = away <= NEAR
        if av.near:
            self._remember(av.trail, self._odometer_of(name), speed)
        elif av.trail:
            av.trail.clear()
        if not av.near or speed < STANDING:  # before then it is not near, or still stands where it is now
            steps = self._steps(away - (0.0 if av.near else NEAR), speed)
        else:
            steps = 1
        self._due[self._count + steps].append(name)
        return entries

    def _steps(self, distance: float, speed: float) -> int:
        """In how many steps a vehicle can at the earliest have driven so many m, as quickly as it can."""
        time = (math.sqrt(speed * speed + 2.0 * HARDEST * max(distance, 0.0)) - speed) / HARDEST  # s
        return max(int(min(time / self._step, LONGEST)), 1)

    @staticmethod
    def _remember(trail: deque[tuple[float, float]], odometer: float, speed: float) -> None:
        """Add the newest; forget what is more than 20 m behind; of a crawl keep one sample per 5 cm."""
        if trail and odometer - trail[-1][0] < 0.05:
            trail[-1] = trail[-1][0], min(trail[-1][1], speed)
        else:
            trail.append((odometer, speed))
        while trail[0][0] < odometer - 2.0 * LAST:
            trail.popleft()

    def _entry(
        self, name: str, av: Watched, passed: Passed, position: float, speed: float, now: float
    ) -> Entry:
        if passed.inside:
            foes = self._foes.of(passed.link, name)
            return Entry(now, name, passed.link, "", speed, speed, foes=foes, inside=True)
        link = self._road.links[passed.link]
        line = self._odometer_of(name) - passed.beyond - position  # the odometer at the line, m
        last = [v for at, v in av.trail if line - LAST - EPSILON <= at]
        state, yellow = "", (-1.0, 0.0, 0.0)
        if link.signal >= 0:
            light, index = self._road.signals[link.signal]
            state = sumo.trafficlight.getRedYellowGreenState(light)[index]
            if state in "yY":
                since, marks = self._lights[light].yellow.get(index, (now - self._step, {}))
                odometer, then = marks.get(name, (line, math.inf))
                yellow = since, line - odometer, then
        foes = () if state == "G" else self._foes.of(passed.link, name)
        return Entry(now, name, passed.link, state, speed, min(last, default=speed), *yellow, foes)

    def _switch(self, began: float) -> None:
        """Read the lights whose next switch was due when the step began (s)."""
        marks: dict[str, tuple[float, float]] | None = None
        while self._switches[0][0] <= began + EPSILON:
            name = heapq.heappop(self._switches)[1]
            light = self._lights[name]
            old, light.state = light.state, sumo.trafficlight.getRedYellowGreenState(name)
            following = began if self._shared else sumo.trafficlight.getNextSwitch(name)
            heapq.heappush(self._switches, (max(following, began + self._step), name))
            if light.state == old:
                continue
            for index, (was, now) in enumerate(zip(old, light.state, strict=True)):
                if now in "yY" and was not in "yY":
                    marks = self._marks() if marks is None else marks
                    light.yellow[index] = began, marks

    def _marks(self) -> dict[str, tuple[float, float]]:
        """Each AV's odometer (m) and speed (m/s) at the beginning of the step that has just been driven."""
        found = {}
        for name in self._avs:
            try:
                speed = self._speed_of(name)
                odometer = self._odometer_of(name) - speed * self._step
                found[name] = odometer, speed - self._accel_of(name) * self._step
            except sumo.TraCIException:
                continue
        return found

    # ---- tables of the road ----

    @cached_property
    def _free(self) -> list[float]:
        """[l] m from a lane's end to the next line that matters, on the shortest way; inf without one."""
        lanes, links = self._road.lanes, self._road.links
        shortest: dict[str, float] = {}  # edge -> m
        length: dict[str, float] = {}
        origins: defaultdict[str, set[str]] = defaultdict(set)  # edge -> the edges that lead to it
        for lane in lanes:
            length[lane.edge] = min(length.get(lane.edge, math.inf), lane.length)
            for successor in lane.successors:
                origins[lanes[successor].edge].add(lane.edge)
        heap = [
            (0.0, lanes[k.origin].edge) for k, matters in zip(links, self._matters, strict=True) if matters
        ]
        heap += [(0.0, lanes[waiting].edge) for waiting, _ in self._goes_on]
        heapq.heapify(heap)
        while heap:
            free, edge = heapq.heappop(heap)
            if edge in shortest:
                continue
            shortest[edge] = free
            for origin in origins[edge]:
                if origin not in shortest:
                    heapq.heappush(heap, (free + length[edge], origin))
        return [shortest.get(lane.edge, math.inf) for lane in lanes]

    @cached_property
    def _goes_on(self) -> dict[tuple[int, int], int]:
        """(internal lane at whose end one may wait for those with the right of way, the next one) -> link."""
        found = {}
        for number, link in enumerate(self._road.links):
            if link.foes and self._road.waits_inside(link.via):
                found[link.via, self._road.lanes[link.via].successors[0]] = number
        return found

    @cached_property
    def _passed(self) -> Callable[[int, int], tuple[Passed, ...]]:
        """The stop lines that matter on the way from one lane to another (asked again, it is free)."""
        return cache(self._lines_between)

    def _lines_between(self, first: int, last: int) -> tuple[Passed, ...]:
        lanes, came = self._road.lanes, {first: first}
        reached = [first]
        for _ in range(HOPS):
            following = []
            for lane in reached:
                for successor in (*lanes[lane].successors, *self._road.lanes_of[lanes[lane].edge]):
                    if successor not in came:
                        came[successor] = lane
                        following.append(successor)
            reached = following
            if last in came:
                break
        else:
            return ()
        found, beyond, lane = [], 0.0, last
        while lane != first:
            before = came[lane]
            link = self._road.link_of.get((before, lane), -1)
            if link >= 0 and self._matters[link]:
                found.append(Passed(link, beyond, False))
            elif (before, lane) in self._goes_on:
                found.append(Passed(self._goes_on[before, lane], beyond, True))
            if lanes[before].edge != lanes[lane].edge:
                beyond += lanes[before].length
            lane = before
        return tuple(reversed(found))
