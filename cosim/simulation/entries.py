"""Detects AVs that pass a stop line, in every simulation step: the frames are too coarse for this.

The watcher checks an AV in every step only within `WATCH_DISTANCE` m of a relevant line: a signal, a stop
sign, or a foe with priority. Elsewhere the next check is the step of the AV's earliest possible arrival.
Signals are read when SUMO announces a switch, or in every step if other programs switch them.
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

LEAST_SPEED_DISTANCE = 10.0  # m before the line, for the least speed (docs/reference/figures.md, The law)
FOE_RANGE = 100.0  # m before its own line, within which a vehicle with priority counts
WATCH_DISTANCE = LEAST_SPEED_DISTANCE + 2.0  # m
MAX_ACCEL = 4.0  # m/s2, an upper bound for every AV
STANDING_SPEED = 0.05  # m/s: speeds below this are not told apart in the last 10 m
MAX_LOOK_INTERVAL = 100  # steps between two checks, because SUMO may teleport an AV
MAX_LANES_PER_STEP = 8  # upper bound
EPSILON = 1e-6


class PassedLine(NamedTuple):
    """A passed stop line, or (`inside`) waiting place inside a junction: its link, and m from it to the start
    of the AV's present lane."""

    link: int
    beyond: float
    inside: bool


@dataclass(slots=True)
class WatchedAv:
    """The last check of one AV."""

    lane: int = -1
    near: bool = False  # to a line
    trail: deque[tuple[float, float]] = field(default_factory=deque)  # (odometer m, speed m/s) near a line


@dataclass(slots=True)
class TrafficLight:
    """The state of one traffic light, and for each link that turned yellow: s, and the AVs' marks then."""

    state: str
    yellow: dict[int, tuple[float, dict[str, tuple[float, float]]]] = field(default_factory=dict)


class EntryWatcher:
    """Yields an `Entry` for every AV that passes a stop line; `step`: s of a simulation step.

    `shared`: whether other programs switch signals too.
    """

    def __init__(self, road: RoadMap, step: float, shared: bool = False) -> None:
        self._road = road
        self._foes = Foes(road, FOE_RANGE)
        self._shared = shared
        self._step = step
        self._relevant = [
            link.signal >= 0 or bool(link.foes) or link.rule in (Rule.STOP, Rule.ALL_WAY_STOP)
            for link in road.links
        ]
        self._lengths = [lane.length for lane in road.lanes]  # [l] m
        self.needed = any(self._relevant)
        get = partial(sumo.getter, "vehicle")
        self._lane_of, self._position_of, self._odometer_of = map(get, ("LaneID", "LanePosition", "Distance"))
        self._speed_of, self._accel_of = map(get, ("Speed", "Acceleration"))
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self._count = 0
        self._avs: dict[str, WatchedAv] = {}
        self._due: defaultdict[int, list[str]] = defaultdict(list)  # step -> the AVs to check
        self._lights: dict[str, TrafficLight] = {}
        self._switches: list[tuple[float, str]] = []  # (s, light), a heap
        if self.needed:
            for light in dict.fromkeys(name for name, _ in self._road.signals):
                state = sumo.trafficlight.getRedYellowGreenState(light)
                self._lights[light] = TrafficLight(state)
                heapq.heappush(self._switches, (-math.inf, light))

    def step(self, now: float, departed: Iterable[str]) -> tuple[Entry, ...]:
        """The entries in the step that ended at `now` (s); `departed`: AVs inserted in that step."""
        if not self.needed:
            return ()
        self._count += 1
        began = now - self._step
        if self._switches and self._switches[0][0] <= began + EPSILON:
            self._switch(began)
        for name in departed:
            self._avs[name] = WatchedAv()
            self._due[self._count].append(name)
        due = self._due.pop(self._count, None)
        return tuple(chain.from_iterable(self._check(name, now) for name in due)) if due else ()

    # ---- inside ----

    def _check(self, name: str, now: float) -> Sequence[Entry]:
        """Check one AV and schedule its next check; its entries."""
        av = self._avs[name]
        try:
            lane = self._road.index.get(self._lane_of(name), -1)
        except sumo.TraCIException:  # the AV has left the road
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
            lines = self._lines_passed(before, lane)
            entries = [self._entry(name, av, passed, position, speed, now) for passed in lines]
        away = self._lengths[lane] - position + self._to_next_line[lane]  # m to the next line
        av.near = away <= WATCH_DISTANCE
        if av.near:
            self._remember(av.trail, self._odometer_of(name), speed)
        elif av.trail:
            av.trail.clear()
        if not av.near or speed < STANDING_SPEED:  # no line before then
            steps = self._steps(away - (0.0 if av.near else WATCH_DISTANCE), speed)
        else:
            steps = 1
        self._due[self._count + steps].append(name)
        return entries

    def _steps(self, distance: float, speed: float) -> int:
        """The minimum number of steps in which a vehicle can drive `distance` m."""
        time = (math.sqrt(speed * speed + 2.0 * MAX_ACCEL * max(distance, 0.0)) - speed) / MAX_ACCEL  # s
        return max(int(min(time / self._step, MAX_LOOK_INTERVAL)), 1)

    @staticmethod
    def _remember(trail: deque[tuple[float, float]], odometer: float, speed: float) -> None:
        """Add a sample; drop samples more than 20 m behind, and keep one per 5 cm of a crawl."""
        if trail and odometer - trail[-1][0] < 0.05:
            trail[-1] = trail[-1][0], min(trail[-1][1], speed)
        else:
            trail.append((odometer, speed))
        while trail[0][0] < odometer - 2.0 * LEAST_SPEED_DISTANCE:
            trail.popleft()

    def _entry(
        self, name: str, av: WatchedAv, passed: PassedLine, position: float, speed: float, now: float
    ) -> Entry:
        if passed.inside:
            foes = self._foes.find(passed.link, name)
            return Entry(now, name, passed.link, "", speed, speed, foes=foes, inside=True)
        link = self._road.links[passed.link]
        line = self._odometer_of(name) - passed.beyond - position  # the odometer at the line, m
        last = [v for at, v in av.trail if line - LEAST_SPEED_DISTANCE - EPSILON <= at]
        state, yellow = "", (-1.0, 0.0, 0.0)
        if link.signal >= 0:
            light, index = self._road.signals[link.signal]
            state = sumo.trafficlight.getRedYellowGreenState(light)[index]
            if state in "yY":
                since, marks = self._lights[light].yellow.get(index, (now - self._step, {}))
                odometer, then = marks.get(name, (line, math.inf))
                yellow = since, line - odometer, then
        foes = () if state == "G" else self._foes.find(passed.link, name)
        return Entry(now, name, passed.link, state, speed, min(last, default=speed), *yellow, foes)

    def _switch(self, began: float) -> None:
        """Read the lights that were due to switch when the step began (s)."""
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
        """Each AV's odometer (m) and speed (m/s) at the beginning of the last step."""
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
    def _to_next_line(self) -> list[float]:
        """[l] m from a lane's end to the next relevant line on the shortest way; inf without a line."""
        lanes, links = self._road.lanes, self._road.links
        shortest: dict[str, float] = {}  # edge -> m
        length: dict[str, float] = {}
        origins: defaultdict[str, set[str]] = defaultdict(set)  # edge -> the edges that lead to it
        for lane in lanes:
            length[lane.edge] = min(length.get(lane.edge, math.inf), lane.length)
            for successor in lane.successors:
                origins[lanes[successor].edge].add(lane.edge)
        heap = [
            (0.0, lanes[k.origin].edge) for k, relevant in zip(links, self._relevant, strict=True) if relevant
        ]
        heap += [(0.0, lanes[waiting].edge) for waiting, _ in self._inner_lines]
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
    def _inner_lines(self) -> dict[tuple[int, int], int]:
        """(internal lane at whose end vehicles may wait for foes, its successor) -> link."""
        found = {}
        for number, link in enumerate(self._road.links):
            if link.foes and self._road.waits_inside(link.via):
                found[link.via, self._road.lanes[link.via].successors[0]] = number
        return found

    @cached_property
    def _lines_passed(self) -> Callable[[int, int], tuple[PassedLine, ...]]:
        """The relevant lines on the way from one lane to another (cached)."""
        return cache(self._lines_between)

    def _lines_between(self, first: int, last: int) -> tuple[PassedLine, ...]:
        lanes, came = self._road.lanes, {first: first}
        reached = [first]
        for _ in range(MAX_LANES_PER_STEP):
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
            if link >= 0 and self._relevant[link]:
                found.append(PassedLine(link, beyond, False))
            elif (before, lane) in self._inner_lines:
                found.append(PassedLine(self._inner_lines[before, lane], beyond, True))
            if lanes[before].edge != lanes[lane].edge:
                beyond += lanes[before].length
            lane = before
        return tuple(reversed(found))
