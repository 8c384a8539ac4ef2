"""Counts from SUMO's own output files alone how AVs kept the law: shares no code with what drives them.

Reads the net and the outputs `fcd` (every simulation step, from the first), `tripinfo`, `vehroute` and
`collision`. FCD stamps a step with the time at which it began; a signal's state in the step is that of its
program at the stamp. Definitions: figures.md, The law. Lengths of vehicles are in none of the files:
all are taken to be cars.
"""

from __future__ import annotations

import itertools
import re
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

OUTPUTS = ("fcd", "tripinfo", "vehroute", "collision")  # of `cosim run --output`
OPTIONS = {  # that make the floating-car data hold every step
    "device.fcd.begin": "0",
    "device.fcd.period": "0",
}
COMFORTABLE = 3.0  # m/s2, with which who can stop has to stop for yellow
HARD = 3.0 + 1e-3  # m/s2; who brakes with just 3 brakes comfortably, and outputs are rounded
STOPPED = 0.5  # m/s, at most, before a stop line
STOP_REACH = 10.0  # m before the line in which it has to be that slow
FOE_REACH = 100.0  # m before a junction
LEADER_REACH = 30.0  # m, or
STOP_ROOM = 10.0  # m more than it takes to stop comfortably
STANDING = 0.1  # m/s, at most
WALK_REACH = 10.0  # m from a crossing
SLOWING = 0.1  # m/s2
PATIENCE = 60.0  # s
QUEUE_GAP = 10.0  # m
BODY = 5.0  # m, a car; FCD has no lengths
FRAME = 2  # steps, over which braking is measured
RED, YELLOW, OFF, GREEN = frozenset("ru"), frozenset("yY"), frozenset("oO"), frozenset("Gg")


def by_type(name: str) -> bool:
    """Whether a vehicle type is an AV's."""
    return name.startswith("cosim.")


@dataclass(frozen=True)
class Lane:
    """A lane of the net."""

    id: str
    length: float  # m
    limit: float  # m/s


@dataclass(frozen=True)
class Zebra:
    """A pedestrian crossing."""

    line: list[complex]  # m, the corners of its centre line
    width: float  # m

    def apart(self, x: float, y: float) -> float:
        """m from a place to its centre line."""
        p, found = complex(x, y), float("inf")
        for a, b in itertools.pairwise(self.line):
            part = ((p - a) * (b - a).conjugate()).real / max(abs(b - a) ** 2, 1e-9)
            found = min(found, abs(p - a - min(max(part, 0.0), 1.0) * (b - a)))
        return found


@dataclass
class Link:
    """A way through a junction from one lane to another."""

    origin: str
    target: str
    via: tuple[str, ...]  # the lanes inside
    junction: str
    state: str  # of the net: M m s w = Z o O
    signal: tuple[str, int] | None  # program and place in its states
    index: int = -1  # in the junction's table
    yields: frozenset[int] = frozenset()  # indices of the links that go first
    meets: frozenset[int] = frozenset()  # indices of the links that it crosses or merges with
    crossings: list[Zebra] = field(default_factory=list)  # that it crosses


@dataclass
class Program:
    """A signal program of fixed times."""

    offset: float  # s
    phases: list[tuple[float, str]]  # s, states

    def at(self, time: float) -> tuple[str, int]:
        """The states at `time`, and the number of phases since time 0 (below 0 before it)."""
        cycle = sum(duration for duration, _ in self.phases)
        laps, rest = divmod(round(time - self.offset, 6), cycle)
        for k, (duration, states) in enumerate(self.phases):
            if rest < duration - 1e-6:
                return states, int(laps) * len(self.phases) + k
            rest -= duration
        return self.phases[0][1], (int(laps) + 1) * len(self.phases)


class Net:
    """What of a net the law needs."""

    def __init__(self, path: Path) -> None:
        root = ET.parse(path).getroot()
        self.lanes: dict[str, Lane] = {}
        self.ends: dict[str, str] = {}  # edge -> junction
        for edge in root.iter("edge"):
            if not edge.get("id", "").startswith(":"):
                self.ends[edge.attrib["id"]] = edge.attrib["to"]
            for lane in edge.iter("lane"):
                numbers = float(lane.attrib["length"]), float(lane.attrib["speed"])
                self.lanes[lane.attrib["id"]] = Lane(lane.attrib["id"], *numbers)
        self.programs: dict[str, Program] = {}
        for logic in root.iter("tlLogic"):
            if logic.get("type") != "static" or logic.attrib["id"] in self.programs:
                raise ValueError(f"{path}: signal {logic.get('id')}: one static program is what is read here")
            phases = [(float(p.attrib["duration"]), p.attrib["state"]) for p in logic.iter("phase")]
            self.programs[logic.attrib["id"]] = Program(float(logic.get("offset", 0)), phases)
        rows = [(c, f"{c.get('from')}_{c.get('fromLane')}") for c in root.iter("connection")]
        onward = {(a, c.attrib["to"], c.attrib["toLane"]): c for c, a in rows if a.startswith(":")}
        self.links: list[Link] = []
        for c, origin in rows:
            begins = c.attrib["from"]
            if begins.startswith(":") or c.attrib["to"].startswith(":"):  # inside; a sidewalk to its corner
                continue
            via: list[str] = []
            after = c.get("via")
            while after:
                via.append(after)
                after = onward[after, c.attrib["to"], c.attrib["toLane"]].get("via")
            tl = c.get("tl")
            self.links.append(
                Link(
                    origin,
                    f"{c.attrib['to']}_{c.attrib['toLane']}",
                    tuple(via),
                    self.ends[begins],
                    c.attrib["state"],
                    None if tl is None else (tl, int(c.attrib["linkIndex"])),
                )
            )
        self.crossings = {
            lane.attrib["id"]: Zebra(
                [complex(*map(float, xy.split(",")[:2])) for xy in lane.attrib["shape"].split()],
                float(lane.attrib["width"]),
            )
            for edge in root.iter("edge")
            if edge.get("function") == "crossing"
            for lane in edge.iter("lane")
        }
        inside = {j.attrib["id"]: j for j in root.iter("junction")}
        for link in self.links:
            junction = inside[link.junction]
            places = junction.get("intLanes", "").split()
            if link.via and link.via[-1] in places:
                link.index = places.index(link.via[-1])
                table = next(r for r in junction.iter("request") if int(r.attrib["index"]) == link.index)
                link.yields, link.meets = (_bits(table.attrib[name]) for name in ("response", "foes"))
                link.crossings = [
                    self.crossings[place]
                    for index, place in enumerate(places)
                    if index in link.meets and place in self.crossings
                ]
        self.of_via = {lane: link for link in self.links for lane in link.via}
        self.of_lane: dict[str, list[Link]] = defaultdict(list)
        self.of_edges: dict[tuple[str, str], list[Link]] = defaultdict(list)
        for link in self.links:
            self.of_lane[link.origin].append(link)
            self.of_edges[_edge(link.origin), _edge(link.target)].append(link)

    def state(self, link: Link, time: float) -> str:
        """A signal's state in the step that begins at `time`, "" where it is off or none."""
        if link.signal is None:
            return ""
        states, _ = self.programs[link.signal[0]].at(time)
        found = states[link.signal[1]]
        return "" if found in OFF else found

    def since(self, link: Link, time: float, wanted: frozenset[str]) -> float:
        """Since when the signal has been in one of the `wanted` states, in which it is at `time`."""
        assert link.signal is not None
        program, place = self.programs[link.signal[0]], link.signal[1]
        cycle = sum(duration for duration, _ in program.phases)
        _, number = program.at(time)
        laps, phase = divmod(number, len(program.phases))
        begin = program.offset + laps * cycle + sum(duration for duration, _ in program.phases[:phase])
        for _ in program.phases:
            duration, states = program.phases[(phase - 1) % len(program.phases)]
            if states[place] not in wanted:
                break
            phase, begin = phase - 1, begin - duration
        return begin


@dataclass
class Track:
    """One vehicle, step by step; `first` is the step of its first row, and there is none missing."""

    id: str
    first: int
    is_av: bool = False
    lane: list[str] = field(default_factory=list)
    pos: Any = field(default_factory=list)  # m on that lane, of the front bumper
    speed: Any = field(default_factory=list)  # m/s
    way: list[str] = field(default_factory=list)  # the edges of its whole route
    place: list[int] = field(default_factory=list)  # per row: index in `way` of its edge or the last one
    step: float = 0.1  # s

    @cached_property
    def driven(self) -> Any:
        """m since the first row."""
        return np.concatenate([[0.0], np.cumsum(self.speed[1:] * self.step)])

    def brakes(self, k: int) -> bool:
        """Whether it brakes hard in the frame that ends with step `k`."""
        row, before = self.row(k), self.row(k - FRAME)
        return min(row, before) >= 0 and (self.speed[before] - self.speed[row]) / (FRAME * self.step) > HARD

    def row(self, k: int) -> int:
        """Its row at step `k`, -1 where it is not on the road."""
        return k - self.first if self.first <= k < self.first + len(self.lane) else -1


@dataclass(frozen=True)
class Violation:
    """One of any kind, to be looked at."""

    kind: str
    time: float  # s, the end of the step
    vehicle: str
    link: str = ""
    what: str = ""


@dataclass
class Law:
    """What was counted, of AVs where not said otherwise."""

    avs: int = 0
    red_light_violations: int = 0
    stop_sign_violations: int = 0
    right_of_way_violations: int = 0
    speeding_steps: int = 0  # above the limit by more than 1 m/s
    av_steps: int = 0
    worst_speeding_mps: float = 0.0  # most above the limit, 0 where never
    worst_speeding_in_frames_mps: float = 0.0  # the same at the ends of frames alone
    avs_stuck: int = 0
    av_trips_completed: int = 0
    trips_completed: int = 0  # of all vehicles
    av_involved_collisions: int = 0  # pairs
    collisions: int = 0  # pairs of all
    hard_brakings_av: int = 0
    distance_mean_m: float = 0.0  # of all vehicles
    entries: int = 0  # of junctions with a signal, a stop sign or foes
    violations: list[Violation] = field(default_factory=list)


def check(net: Path, folder: Path, is_av: Callable[[str], bool] = by_type) -> Law:
    """Count what the `folder` of an episode's outputs holds.

    `is_av`: whether a vehicle type is an AV's; a vehicle that once has such a type is one all the time.
    """
    return Checker(Net(net), folder, is_av).run()


class Checker:
    """One episode."""

    def __init__(self, net: Net, folder: Path, is_av: Callable[[str], bool]) -> None:
        self.net, self.folder = net, folder
        self.times: list[float] = []
        self.tracks: dict[str, Track] = {}
        self.on_lane: list[dict[str, list[tuple[float, str]]]] = []  # per step: lane -> (pos, vehicle)
        self.persons: list[list[tuple[float, float]]] = []  # per step, where they are
        self._read_fcd(folder / "fcd.xml", is_av)
        self._read_ways(folder / "vehroute.xml")
        self.touched: dict[frozenset[str], list[float]] = defaultdict(list)
        for row in ET.parse(folder / "collision.xml").getroot().iter("collision"):
            pair = frozenset((row.attrib["collider"], row.attrib["victim"]))
            self.touched[pair].append(float(row.attrib["time"]))
        self.law = Law()

    def run(self) -> Law:
        """Count."""
        law, tracks = self.law, self.tracks
        avs = [track for track in tracks.values() if track.is_av]
        law.avs, names = len(avs), {track.id for track in avs}
        for track in avs:
            self._speeding(track)
            self._entries(track)
            self._stuck(track)
            ends = range(track.first + _until_end(track.first), track.first + len(track.lane), FRAME)
            hard = [track.brakes(k) for k in ends]
            law.hard_brakings_av += sum(b and not a for a, b in itertools.pairwise(hard))
        arrived = [
            row.attrib["id"]
            for row in ET.parse(self.folder / "tripinfo.xml").getroot().iter("tripinfo")
            if float(row.attrib["arrival"]) >= 0.0 and not row.get("vaporized")
        ]
        law.trips_completed = len(arrived)
        law.av_trips_completed = len(names.intersection(arrived).difference(*self.touched))
        law.collisions = len(self.touched)
        law.av_involved_collisions = sum(bool(pair & names) for pair in self.touched)
        law.distance_mean_m = float(np.mean([t.driven[-1] for t in tracks.values()])) if tracks else 0.0
        law.violations.sort(key=lambda v: v.time)
        return law

    # ---- what is counted ----

    def _speeding(self, av: Track) -> None:
        limits = np.array([self.net.lanes[lane].limit for lane in av.lane])
        excess = av.speed - limits
        excess[0] = min(excess[0], 0.0)  # the step of its insertion, at the speed that its file asks for
        law, worst = self.law, int(np.argmax(excess))
        law.av_steps += len(excess)
        law.speeding_steps += int(np.sum(excess > 1.0))
        law.worst_speeding_mps = max(law.worst_speeding_mps, float(excess[worst]))
        in_frames = excess[_until_end(av.first) :: FRAME]
        law.worst_speeding_in_frames_mps = max([law.worst_speeding_in_frames_mps, *in_frames.tolist()])
        if excess[worst] > 1.0:
            self._found("speeding", av, worst, None, f"{av.speed[worst]:.2f} m/s on {av.lane[worst]}")

    def _entries(self, av: Track) -> None:
        for row in range(1, len(av.lane)):
            for link, over in self._entered(av, row):
                time = self.times[av.first + row]
                state = self.net.state(link, time)
                self.law.entries += bool(state or link.yields or link.state in "sw")
                line = av.driven[row] - over  # m driven when the line was passed
                if state in RED or (state in YELLOW and self._could_stop(av, link, time, line)):
                    self._found("red_light", av, row, link, state)
                    self.law.red_light_violations += 1
                if state == "s" or (link.signal is None and link.state in "sw"):
                    near = av.speed[:row][av.driven[:row] >= line - STOP_REACH]
                    least = near.min() if len(near) else av.speed[row - 1]
                    if least > STOPPED:
                        self._found("stop_sign", av, row, link, f"at least {least:.2f} m/s")
                        self.law.stop_sign_violations += 1
                # where the net lets it wait inside, nobody is made to brake before it goes on from there
                waits = len(link.via) > 1 and bool(link.yields)
                goes = self._goes_on(av, row, link) if waits else row
                foe = self._wronged(av, row, link, time, until=goes) if waits else ""
                if goes is not None and not foe:
                    foe = self._wronged(av, goes, link, self.times[av.first + goes])
                if foe:
                    self._found("right_of_way", av, row, link, foe)
                    self.law.right_of_way_violations += 1

    def _could_stop(self, av: Track, link: Link, time: float, line: float) -> bool:
        """Whether it could when yellow began: at the end of the step before the first yellow one."""
        begin = self.net.since(link, time, YELLOW)
        row = av.row(int(np.searchsorted(self.times, begin - 1e-6)) - 1)
        return row >= 0 and bool(line - av.driven[row] >= av.speed[row] ** 2 / (2.0 * COMFORTABLE))

    @staticmethod
    def _goes_on(av: Track, row: int, link: Link) -> int | None:
        """The row in which the front of an AV that entered in `row` leaves the first lane inside."""
        rows = (r for r in range(row, len(av.lane)) if av.lane[r] not in (link.via[0], link.origin))
        return next(rows, None)

    def _wronged(self, av: Track, row: int, link: Link, time: float, until: int | None = -1) -> str:
        """The first foe with the right of way that the entry touched or made to brake hard; "" if none.

        `until`: the row from which on it is looked at anew (None: never), before which only touching counts.
        """
        waits, begin, end = until != -1, av.first + row, self._left(av, row, link)
        if waits and until is not None:
            end = av.first + until
        if self.net.state(link, time) == "G":
            return ""
        frames = range(begin + FRAME + _until_end(begin), end + 1, FRAME)  # the steps that end them
        for foe, other in self._foes(av, begin, link, time):
            touched = [t for t in self.touched.get(frozenset((av.id, foe.id)), ()) if t >= time - 1e-6]
            if touched and touched[0] <= self.times[end] + 1e-6:
                return f"{foe.id} touched"
            if waits or (link.state in "w=Z" and link.signal is None):
                continue  # or by turns
            for k in frames:
                if foe.brakes(k) and not foe.brakes(k - FRAME) and not self._excused(foe, k, other, av.id):
                    return f"{foe.id} braked hard until {self.times[k] + av.step:.1f} s"
        return ""

    def _left(self, av: Track, row: int, link: Link) -> int:
        """The step at the end of the first frame in which the AV is out of the junction, its rear bumper too,
        or the last step that it is seen at."""
        for k in range(av.first + row, av.first + len(av.lane)):
            lane, r = av.lane[av.row(k)], av.row(k)
            behind = _edge(lane) == _edge(link.target) and av.pos[r] < BODY
            if lane not in link.via and not behind and (k + 1) % FRAME == 0:
                return k
        return av.first + len(av.lane) - 1

    def _foes(self, av: Track, k: int, link: Link, time: float) -> Iterator[tuple[Track, Link]]:
        """Vehicles with the right of way that at step `k` are on their way, or within its reach."""
        for foe in self.tracks.values():
            row = foe.row(k)
            if foe.id == av.id or row < 0:
                continue
            for other in self._coming(foe, row, link.junction):
                signal = self.net.state(other, time)
                if other.index in link.yields & link.meets and signal not in RED:
                    yield foe, other
                    break

    def _coming(self, foe: Track, row: int, junction: str) -> list[Link]:
        """The links of the junction that it is on, or comes to within `FOE_REACH`."""
        lane, place = foe.lane[row], foe.place[row]
        ahead = self.net.lanes[lane].length - foe.pos[row]
        if lane.startswith(":"):
            link = self.net.of_via.get(lane)
            if link is None:
                return []
            if link.junction == junction:
                return [link]
            place += 1
            ahead += self.net.lanes[f"{foe.way[place]}_0"].length if place < len(foe.way) else 0.0
        lanes = {lane if not lane.startswith(":") else self.net.of_via[lane].target}
        while ahead <= FOE_REACH and place + 1 < len(foe.way):
            links = self.net.of_edges[foe.way[place], foe.way[place + 1]]
            links = [link for link in links if link.origin in lanes] or links  # or it has to change lanes
            if not links:
                return []
            if links[0].junction == junction:
                return links
            inside = sum(self.net.lanes[via].length for via in links[0].via)
            ahead += inside + self.net.lanes[links[0].target].length
            lanes = {link.target for link in links}
            place += 1
        return []

    def _excused(self, foe: Track, k: int, link: Link, av: str) -> bool:
        """Whether a foe on the way of `link` has another reason to brake: its signal or stop sign, persons at
        a crossing, somebody else near ahead on its lane or link or the lane behind it or turning off its
        lane, or that it is past the junction."""
        row = foe.row(k)
        lane, gone = foe.lane[row], -foe.pos[row]
        reach = max(LEADER_REACH, foe.speed[row] ** 2 / (2.0 * COMFORTABLE) + STOP_ROOM)
        if _edge(lane) == _edge(link.target):
            return True
        if lane in link.via:
            lanes = (*link.via[link.via.index(lane) :], link.target)
        else:
            if self.net.state(link, self.times[k]) not in GREEN | {""}:
                return True
            if link.signal is None and link.state in "sw":
                return True
            lanes = (lane, *link.via, link.target) if lane == link.origin else (lane,)
        walked = any(zebra.apart(*at) <= WALK_REACH for zebra in link.crossings for at in self.persons[k])
        at_line = lane == link.origin and self.net.lanes[lane].length + gone <= reach
        if walked and (at_line or lane in link.via):
            return True
        if not lane.startswith(":"):  # who turns off its lane, and has not left it wholly
            rest = self.net.lanes[lane].length + gone
            for other in self.net.of_lane[lane]:
                for pos, name in self.on_lane[k].get(other.via[0], ()) if other.via else ():
                    if name not in (foe.id, av) and pos < BODY and rest + pos <= reach + BODY:
                        return True
        for one in lanes:
            for pos, name in self.on_lane[k].get(one, ()):
                if name not in (foe.id, av) and 0.0 < gone + pos <= reach + BODY:
                    return True
            gone += self.net.lanes[one].length
        return False

    def _stuck(self, av: Track) -> None:
        since = None
        for row, speed in enumerate(av.speed):
            k = av.first + row
            if speed >= STANDING or self._waits(av, k, set()):
                since = None
                continue
            since = k if since is None else since
            if self.times[k] - self.times[since] > PATIENCE:
                self._found("stuck", av, row, None, av.lane[row])
                self.law.avs_stuck += 1
                return

    def _waits(self, track: Track, k: int, seen: set[str]) -> bool:
        """Whether a red or yellow signal, persons on a crossing, or a queue before one of these or behind a
        human are ahead in its lane."""
        row, seen = track.row(k), seen | {track.id}
        lane = track.lane[row]
        if any(self.net.state(link, self.times[k]) in RED | YELLOW for link in self.net.of_lane[lane]):
            return True
        links = [self.net.of_via[lane]] if lane in self.net.of_via else self.net.of_lane[lane]
        zebras = [zebra for link in links for zebra in link.crossings]
        if any(zebra.apart(*at) <= 0.5 * zebra.width for zebra in zebras for at in self.persons[k]):
            return True
        free = True
        for pos, name in self.on_lane[k].get(lane, ()):
            if name == track.id or not 0.0 < pos - track.pos[row] <= QUEUE_GAP + BODY:
                continue
            ahead = self.tracks[name]
            r = ahead.row(k)
            slows = r > 0 and ahead.speed[r - 1] - ahead.speed[r] > SLOWING * track.step
            if ahead.speed[r] < STANDING or slows:
                free = False
                if name not in seen and self._waits(ahead, k, seen):
                    return True
        return free and not track.is_av

    def _entered(self, av: Track, row: int) -> list[tuple[Link, float]]:
        """The links whose stop lines its front passed in this step, each with how far it is beyond (m)."""
        before, now = av.lane[row - 1], av.lane[row]
        if before.startswith(":") and now.startswith(":"):
            # a road shorter than a step between two junctions
            if self.net.of_via.get(before) is self.net.of_via.get(now) or av.place[row] == av.place[row - 1]:
                return []
        elif not now.startswith(":") and av.place[row] == av.place[row - 1]:
            return []  # on one edge
        ways = av.way[av.place[row - 1] : av.place[row] + 1]
        pairs = list(itertools.pairwise(ways))
        if before.startswith(":"):
            pairs = pairs[1:]  # the first is the junction that it was in
        links: list[Link] = []
        if now.startswith(":"):
            last = self.net.of_via.get(now)
            tail = [] if last is None else [last]
        else:
            tail = []
        for a, b in pairs:
            options = self.net.of_edges[a, b]
            links += [link for link in options if link.origin == before][:1] or options[:1]
        links += tail
        found, beyond = [], float(av.pos[row])
        ahead: list[str] = list(tail[0].via[: tail[0].via.index(now)]) if tail else []
        for link in reversed(links):
            inside = ahead if link in tail else list(link.via)
            beyond += sum(self.net.lanes[via].length for via in inside)
            found.append((link, beyond))
            beyond += self.net.lanes[link.origin].length
        return found[::-1]

    # ---- files ----

    def _read_fcd(self, path: Path, is_av: Callable[[str], bool]) -> None:
        for _, element in ET.iterparse(path):
            if element.tag != "timestep":
                continue
            k = len(self.times)
            self.times.append(float(element.attrib["time"]))
            lanes: dict[str, list[tuple[float, str]]] = defaultdict(list)
            for row in element.iter("vehicle"):
                get = row.attrib
                if not get["lane"]:
                    continue
                track = self.tracks.get(get["id"])
                if track is None:
                    track = self.tracks[get["id"]] = Track(get["id"], k)
                if track.first + len(track.lane) != k:
                    raise ValueError(f"{path}: {track.id} is off the road and on it again")
                track.is_av |= is_av(get["type"])
                track.lane.append(get["lane"])
                track.pos.append(float(get["pos"]))
                track.speed.append(float(get["speed"]))
                lanes[get["lane"]].append((float(get["pos"]), track.id))
            self.on_lane.append(lanes)
            walking = element.iter("person")
            self.persons.append([(float(p.attrib["x"]), float(p.attrib["y"])) for p in walking])
            element.clear()
        if len(self.times) > 1:
            step = round(self.times[1] - self.times[0], 6)
            if any(abs(b - a - step) > 1e-3 for a, b in itertools.pairwise(self.times)):
                raise ValueError(f"{path}: not every step is there: ask for {OPTIONS}")
            for track in self.tracks.values():
                track.step = step
        for track in self.tracks.values():
            track.pos, track.speed = np.array(track.pos), np.array(track.speed)

    def _read_ways(self, path: Path) -> None:
        """Each vehicle's whole way: what it drove, then the rest of its last route."""
        routes = {}
        for vehicle in ET.parse(path).getroot().iter("vehicle"):
            routes[vehicle.attrib["id"]] = [r.attrib["edges"].split() for r in vehicle.iter("route")][-1]
        for track in self.tracks.values():
            route, edges = routes.get(track.id, []), [_edge(lane) for lane in track.lane]
            if edges[0].startswith(":"):
                raise ValueError(f"{track.id} begins inside a junction")
            for edge in edges:
                if edge.startswith(":") or (track.way and track.way[-1] == edge):
                    pass
                elif track.way and edge in route[len(track.way) :]:  # edges shorter than a step are not seen
                    track.way += route[len(track.way) : route.index(edge, len(track.way)) + 1]
                else:
                    track.way.append(edge)
                track.place.append(len(track.way) - 1)
            track.way += route[len(track.way) :]

    def _found(self, kind: str, av: Track, row: int, link: Link | None, what: str) -> None:
        time = self.times[av.first + row] + av.step
        way = "" if link is None else f"{link.origin} -> {link.target}"
        self.law.violations.append(Violation(kind, round(time, 3), av.id, way, what))


def _edge(lane: str) -> str:
    return lane.rpartition("_")[0]


def _until_end(step: int) -> int:
    """Steps from `step` to the one with which its frame ends."""
    return -(step + 1) % FRAME


def _bits(row: str) -> frozenset[int]:
    """SUMO writes the last link first."""
    return frozenset(k for k, bit in enumerate(reversed(row)) if bit == "1")


def main() -> None:
    """`python -m tests.law.checker NET FOLDER [TYPE]`: what it counts; TYPE: regular expression of AVs."""
    import sys

    pattern = re.compile(sys.argv[3] if len(sys.argv) > 3 else r"cosim\.")
    law = check(Path(sys.argv[1]), Path(sys.argv[2]), lambda name: pattern.match(name) is not None)
    for name, value in vars(law).items():
        if name == "violations":
            print(*value, sep="\n")
        else:
            print(f"{name} {value}")


if __name__ == "__main__":
    main()
