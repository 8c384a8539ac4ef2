"""Parametric open roads: plain XML sources and flows of each kind, and the similarity of two roads.

The six named roads (`NAMED`, folders `open/NAME`) are tests; `sumo_scenarios.draw` draws random ones.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple
from xml.sax.saxutils import quoteattr

ENTRY_LENGTH = 100.0  # m without lane changes, since SUMO inserts vehicles beside lane-changing ones
PARALLEL_LENGTH = 60.0  # m of ramp beside the main road; else netconvert builds a junction of 50 m
LANE_WIDTH = 3.2  # m, SUMO's default
RAMP_SPEED = 22.22  # m/s
SIDE_LENGTH = 200.0  # m, of a side street
FREE, BEST = "free", "best"  # values of SUMO's departLane


class Flow(NamedTuple):
    """Vehicles of one origin and destination."""

    origin: str  # edge
    destination: str  # edge
    share: float  # of all vehicles
    lane: str = FREE  # SUMO's departLane


class Section(NamedTuple):
    """The measurement section of a bottleneck: flow through it and density upstream."""

    approaches: tuple[str, ...]  # edges before the bottleneck
    exits: tuple[str, ...]  # edges behind it
    reach: float  # m, length of the section at the end of each approach


class Timing(NamedTuple):
    """A fixed-time signal program; s."""

    main: float  # green of the arterial
    side: float  # green of the side street
    offset: float  # from one signal to the next


Sources = Mapping[str, str]  # nod, edg, con -> XML; keys of `sumo_scenarios.build.SOURCES`


@dataclass(frozen=True)
class Road:
    """A road and its flows; lengths in m, speeds in m/s."""

    kind: ClassVar[str]
    title: ClassVar[str]
    speed: float = 30.0  # limit of the main road
    lanes: int = 2  # of the main road, per direction

    @property
    def layout(self) -> tuple[int, ...]:
        """Numbers of lanes, arms and signals, equal for similar roads."""
        return (self.lanes,)

    @property
    def size(self) -> float | None:
        """m, the length in which drivers interact; None without such a length."""
        return None

    @property
    def lanes_at_bottleneck(self) -> int:
        """Divisor of the capacity when comparing roads of one kind."""
        return self.lanes

    @property
    def section(self) -> Section:
        """The section for measuring capacity."""
        raise NotImplementedError

    @property
    def timing(self) -> Timing | None:
        """The signal timing; None without signals."""
        return None

    def sources(self) -> Sources:
        """Plain XML for netconvert."""
        raise NotImplementedError

    def flows(self) -> Sequence[Flow]:
        """The flows, with shares that sum to 1."""
        raise NotImplementedError


@dataclass(frozen=True)
class LaneDrop(Road):
    """Right or left lanes of a motorway end."""

    kind = "lane_drop"
    title = "a motorway whose lanes end"
    lanes: int = 3
    after: int = 2
    from_the_right: bool = True
    before_m: float = 1000.0
    after_m: float = 400.0
    speed: float = 30.0

    @property
    def layout(self) -> tuple[int, ...]:
        return self.lanes, self.after

    @property
    def lanes_at_bottleneck(self) -> int:
        return self.after

    @property
    def section(self) -> Section:
        return Section(("before",), ("after",), 500.0)

    def sources(self) -> Sources:
        x = [-self.before_m - ENTRY_LENGTH, -self.before_m, 0.0, self.after_m]
        first = (
            self.lanes - self.after if self.from_the_right else 0
        )  # the lane that continues as the rightmost
        return {
            "nod": _nodes({name: (at, 0.0) for name, at in zip("abcd", x, strict=True)}),
            "edg": _edges(
                _entry("entry", "a", "b", self.lanes, self.speed, f"{x[0]:g},0 {x[1]:g},0"),
                _edge("before", "b", "c", self.lanes, self.speed, shape=f"{x[1]:g},0 0,0", spread="right"),
                _edge("after", "c", "d", self.after, self.speed, shape=self._after, spread="right"),
            ),
            "con": _connections(
                *_straight("entry", "before", self.lanes),
                *(("before", "after", first + lane, lane) for lane in range(self.after)),
            ),
        }

    @property
    def _after(self) -> str:
        """Shape along the left edge of the carriageway, which shifts if left lanes end."""
        y = 0.0 if self.from_the_right else -LANE_WIDTH * (self.lanes - self.after)
        return f"0,{y:g} {self.after_m:g},{y:g}"

    def flows(self) -> Sequence[Flow]:
        return (Flow("entry", "after", 1.0),)


@dataclass(frozen=True)
class OnRamp(Road):
    """An on-ramp of one lane joins a motorway with an acceleration lane."""

    kind = "on_ramp"
    title = "an on-ramp with an acceleration lane"
    lanes: int = 2
    acceleration_m: float = 250.0
    ramp_share: float = 0.2
    before_m: float = 900.0
    after_m: float = 500.0
    ramp_m: float = 350.0
    speed: float = 30.0

    @property
    def size(self) -> float | None:
        return self.acceleration_m

    @property
    def section(self) -> Section:
        return Section(("before",), ("after",), 500.0)

    def sources(self) -> Sources:
        n, join, end = self.lanes, self.acceleration_m, self.acceleration_m + self.after_m
        x = [-self.before_m - ENTRY_LENGTH, -self.before_m, 0.0, join, end]
        nodes = {name: (at, 0.0) for name, at in zip("abcde", x, strict=True)}
        return {
            "nod": _nodes(nodes | {"r": (-self.ramp_m, -LANE_WIDTH * n - 60.0)}),
            "edg": _edges(
                _entry("entry", "a", "b", n, self.speed, f"{x[0]:g},0 {x[1]:g},0"),
                _edge("before", "b", "c", n, self.speed, shape=f"{x[1]:g},0 0,0", spread="right"),
                _edge("ramp", "r", "c", 1, RAMP_SPEED, 1, _ramp(-self.ramp_m, n), "right"),
                _edge("joining", "c", "d", n + 1, self.speed, shape=f"0,0 {join:g},0", spread="right"),
                _edge("after", "d", "e", n, self.speed, shape=f"{join:g},0 {end:g},0", spread="right"),
            ),
            "con": _connections(
                *_straight("entry", "before", n),
                *(("before", "joining", lane, lane + 1) for lane in range(n)),
                ("ramp", "joining", 0, 0),
                *(("joining", "after", lane + 1, lane) for lane in range(n)),
            ),
        }

    def flows(self) -> Sequence[Flow]:
        return (
            Flow("entry", "after", 1.0 - self.ramp_share),
            Flow("ramp", "after", self.ramp_share, BEST),
        )


@dataclass(frozen=True)
class Weave(Road):
    """A lane connects an on-ramp with an off-ramp, and traffic streams weave there."""

    kind = "weave"
    title = "a weaving section between two ramps"
    lanes: int = 2  # of the main road, without the lane that connects the ramps
    weave_m: float = 400.0
    on_share: float = 0.14
    off_share: float = 0.14
    both_share: float = 0.03  # from ramp to ramp
    before_m: float = 900.0
    after_m: float = 400.0
    ramp_m: float = 350.0
    speed: float = 30.0

    @property
    def size(self) -> float | None:
        return self.weave_m

    @property
    def section(self) -> Section:
        return Section(("before",), ("after", "leave"), 500.0)

    def sources(self) -> Sources:
        n, cross, end = self.lanes, self.weave_m, self.weave_m + self.after_m
        x = [-self.before_m - ENTRY_LENGTH, -self.before_m, 0.0, cross, end]
        nodes = {name: (at, 0.0) for name, at in zip("abcde", x, strict=True)}
        away = -LANE_WIDTH * n - 60.0
        ramps = {"r": (-self.ramp_m, away), "o": (cross + self.ramp_m, away)}
        leaving = " ".join(reversed([_mirrored(point, cross) for point in _ramp(-self.ramp_m, n).split()]))
        return {
            "nod": _nodes(nodes | ramps),
            "edg": _edges(
                _entry("entry", "a", "b", n, self.speed, f"{x[0]:g},0 {x[1]:g},0"),
                _edge("before", "b", "c", n, self.speed, shape=f"{x[1]:g},0 0,0", spread="right"),
                _edge("ramp", "r", "c", 1, RAMP_SPEED, 1, _ramp(-self.ramp_m, n), "right"),
                _edge("weaving", "c", "d", n + 1, self.speed, shape=f"0,0 {cross:g},0", spread="right"),
                _edge("after", "d", "e", n, self.speed, shape=f"{cross:g},0 {end:g},0", spread="right"),
                _edge("leave", "d", "o", 1, RAMP_SPEED, 1, leaving, "right"),
            ),
            "con": _connections(
                *_straight("entry", "before", n),
                *(("before", "weaving", lane, lane + 1) for lane in range(n)),
                ("ramp", "weaving", 0, 0),
                ("weaving", "leave", 0, 0),
                *(("weaving", "after", lane + 1, lane) for lane in range(n)),
            ),
        }

    def flows(self) -> Sequence[Flow]:
        return (
            Flow("entry", "after", 1.0 - self.on_share - self.off_share - self.both_share),
            Flow("entry", "leave", self.off_share),
            Flow("ramp", "after", self.on_share, BEST),
            Flow("ramp", "leave", self.both_share, BEST),
        )


@dataclass(frozen=True)
class Roundabout(Road):
    """A roundabout with equally many lanes on arms and ring; entering vehicles yield."""

    kind = "roundabout"
    title = "a roundabout"
    lanes: int = 2
    arms: int = 4
    radius: float = 35.0  # of the ring's middle
    through_share: float = 0.5  # weight of the second exit, for vehicles that pass the first
    first_exit_share: float = 0.25
    arm_m: float = 350.0
    speed: float = 13.89
    ring_speed: float = 8.33

    @property
    def layout(self) -> tuple[int, ...]:
        return self.lanes, self.arms

    @property
    def size(self) -> float | None:
        return self.radius

    @property
    def section(self) -> Section:
        every = range(self.arms)
        return Section(tuple(f"in{k}" for k in every), tuple(f"out{k}" for k in every), 200.0)

    def sources(self) -> Sources:
        every, edges, nodes = range(self.arms), [], {}
        for k in every:
            nodes[f"ring{k}"], nodes[f"far{k}"] = self._at(k, 0.0), self._at(k, self.arm_m)
            following = (k + 1) % self.arms
            shape = " ".join(
                f"{x:.2f},{y:.2f}" for x, y in (self._at(k + part / 8, 0.0) for part in range(9))
            )
            edges += [
                _edge(f"ring{k}", f"ring{k}", f"ring{following}", self.lanes, self.ring_speed, 3, shape),
                _edge(f"in{k}", f"far{k}", f"ring{k}", self.lanes, self.speed, 1),
                _edge(f"out{k}", f"ring{k}", f"far{k}", self.lanes, self.speed, 1),
            ]
        ring = " ".join(f"ring{k}" for k in every)
        edges.append(f'    <roundabout nodes="{ring}" edges="{ring}"/>')
        # The outer of several ring lanes ends at the next exit, so that lanes do not cross at exits. If both
        # lanes continue and exit (or only the outer one exits, netconvert's default), human traffic locks.
        links: list[tuple[str, str, int, int]] = []
        for k in every:
            before = f"ring{(k - 1) % self.arms}"
            on = range(1 if self.lanes > 1 else 0, self.lanes)
            links += [(before, f"ring{k}", lane, lane) for lane in on]
            links += _straight(f"in{k}", f"ring{k}", self.lanes)
            links += _straight(before, f"out{k}", self.lanes)
        return {"nod": _nodes(nodes), "edg": _edges(*edges), "con": _connections(*links)}

    def _at(self, arm: float, out: float) -> tuple[float, float]:
        """The point `out` m outside the ring at `arm`; arms count counter-clockwise, as traffic drives."""
        angle, far = 2.0 * math.pi * arm / self.arms, self.radius + out
        return far * math.cos(angle), far * math.sin(angle)

    def flows(self) -> Sequence[Flow]:
        return tuple(
            Flow(f"in{k}", f"out{(k + step) % self.arms}", share / self.arms, BEST)
            for k in range(self.arms)
            for step, share in self._turns()
        )

    def _turns(self) -> Iterator[tuple[int, float]]:
        """Exits: number of arms from the entry, and share of the arm's vehicles."""
        later = range(2, self.arms)
        yield 1, self.first_exit_share
        rest = 1.0 - self.first_exit_share
        weights = [self.through_share if step == 2 else 1.0 - self.through_share for step in later]
        yield from ((step, rest * w / sum(weights)) for step, w in zip(later, weights, strict=True))


@dataclass(frozen=True)
class Minor(Road):
    """A minor road yields to a busy road, at a T-junction or crossroads."""

    kind = "minor"
    title = "a minor road onto a busy one"
    lanes: int = 1  # of the busy road, per direction
    arms: int = 3
    minor_share: float = 0.2
    into_share: float = 0.06  # of each direction of the busy road: right turns into a minor road
    main_m: float = 600.0
    minor_m: float = 400.0
    speed: float = 16.67
    minor_speed: float = 13.89

    @property
    def layout(self) -> tuple[int, ...]:
        return self.lanes, self.arms

    @property
    def section(self) -> Section:
        exits = ("west_out", "east_out", *(f"{arm}_out" for arm in self._minors))
        return Section(tuple(f"{arm}_in" for arm in self._minors), exits, 300.0)

    @property
    def _minors(self) -> tuple[str, ...]:
        return ("south", "north")[: self.arms - 2]

    def sources(self) -> Sources:
        far = {"west": (-self.main_m, 0.0), "east": (self.main_m, 0.0)}
        far |= {arm: (0.0, {"south": -1, "north": 1}[arm] * self.minor_m) for arm in self._minors}
        edges = []
        for arm in far:
            main = arm in ("west", "east")
            lanes, speed, rank = (self.lanes, self.speed, 3) if main else (1, self.minor_speed, 1)
            edges += [
                _edge(f"{arm}_in", arm, "crossing", lanes, speed, rank),
                _edge(f"{arm}_out", "crossing", arm, lanes, speed, rank),
            ]
        return {"nod": _nodes(far | {"crossing": (0.0, 0.0)}), "edg": _edges(*edges)}

    def flows(self) -> Sequence[Flow]:
        minors = self._minors
        main, each = (1.0 - self.minor_share) / 2.0, self.minor_share / len(minors)
        found = []
        for side, opposite, right in (("west", "east", "south"), ("east", "west", "north")):
            into = main * self.into_share if right in minors else 0.0
            found += [Flow(f"{side}_in", f"{opposite}_out", main - into, BEST)]
            found += [Flow(f"{side}_in", f"{right}_out", into, BEST)] if into else []
        for arm, across in (("south", "north"), ("north", "south"))[: len(minors)]:
            ways = [("west_out", 0.3), ("east_out", 0.3), (f"{across}_out", 0.4)]
            ways = ways if len(minors) == 2 else [("west_out", 0.5), ("east_out", 0.5)]
            found += [Flow(f"{arm}_in", way, each * share, BEST) for way, share in ways]
        return tuple(found)


@dataclass(frozen=True)
class Arterial(Road):
    """Signals in a row; the arterial has through and right turns, the side streets all turns."""

    kind = "arterial"
    title = "a signalised arterial"
    signals: int = 3
    lanes: int = 2  # per direction
    block_m: float = 300.0
    main_green: float = 26.0  # s
    side_green: float = 30.0  # s
    offset: float = 21.0  # s
    side_share: float = 0.4  # of all vehicles, from the side streets
    speed: float = 13.89
    ends_m: float = 400.0

    @property
    def layout(self) -> tuple[int, ...]:
        return self.signals, self.lanes

    @property
    def size(self) -> float | None:
        return self.block_m

    @property
    def timing(self) -> Timing | None:
        return Timing(self.main_green, self.side_green, self.offset)

    @property
    def section(self) -> Section:
        n = self.signals
        exits = [f"{side}{k}_out" for k in range(n) for side in ("south", "north")]
        return Section(("east0", f"west{n}"), (f"east{n}", "west0", *exits), 300.0)

    def sources(self) -> Sources:
        n, edges = self.signals, []
        links: list[tuple[str, str, int, int]] = []
        nodes = {f"tls{k}": (k * self.block_m, 0.0) for k in range(n)}
        ends = {"begin": (-self.ends_m, 0.0), "end": ((n - 1) * self.block_m + self.ends_m, 0.0)}
        row = ["begin", *nodes, "end"]
        for k, (a, b) in enumerate(pairwise(row)):
            edges += [
                _edge(f"east{k}", a, b, self.lanes, self.speed, 3),
                _edge(f"west{k}", b, a, self.lanes, self.speed, 3),
            ]
        far = {}
        for k in range(n):
            for side, way in (("south", -1.0), ("north", 1.0)):
                far[f"{side}{k}"] = (k * self.block_m, way * SIDE_LENGTH)
                edges += [
                    _edge(f"{side}{k}_in", f"{side}{k}", f"tls{k}", 1, self.speed, 1),
                    _edge(f"{side}{k}_out", f"tls{k}", f"{side}{k}", 1, self.speed, 1),
                ]
            links += self._links(k)
        return {
            "nod": _nodes(ends | far | nodes, signals=nodes.keys()),
            "edg": _edges(*edges),
            "con": _connections(*links),
        }

    def _links(self, k: int) -> Iterator[tuple[str, str, int, int]]:
        left = self.lanes - 1
        yield from _straight(f"east{k}", f"east{k + 1}", self.lanes)
        yield from _straight(f"west{k + 1}", f"west{k}", self.lanes)
        yield f"east{k}", f"south{k}_out", 0, 0
        yield f"west{k + 1}", f"north{k}_out", 0, 0
        yield f"south{k}_in", f"north{k}_out", 0, 0
        yield f"south{k}_in", f"east{k + 1}", 0, 0
        yield f"south{k}_in", f"west{k}", 0, left
        yield f"north{k}_in", f"south{k}_out", 0, 0
        yield f"north{k}_in", f"west{k}", 0, 0
        yield f"north{k}_in", f"east{k + 1}", 0, left

    def flows(self) -> Sequence[Flow]:
        n, turning = self.signals, 0.06  # turning share of the arterial's vehicles per signal
        main, side = (1.0 - self.side_share) / 2.0, self.side_share / (2.0 * n)
        through = main * (1.0 - turning * n)
        found = [Flow("east0", f"east{n}", through, BEST), Flow(f"west{n}", "west0", through, BEST)]
        for k in range(n):
            found += [
                Flow("east0", f"south{k}_out", main * turning, BEST),
                Flow(f"west{n}", f"north{k}_out", main * turning, BEST),
            ]
            for here, there in (("south", "north"), ("north", "south")):
                ways = [(f"{there}{k}_out", 0.6), (f"east{n}", 0.2), ("west0", 0.2)]
                found += [Flow(f"{here}{k}_in", way, side * share, BEST) for way, share in ways]
        return tuple(found)


KINDS: tuple[type[Road], ...] = (LaneDrop, OnRamp, Weave, Roundabout, Minor, Arterial)
NAMED: Mapping[str, Road] = {kind.kind: kind() for kind in KINDS}  # open/NAME
ALIKE = 1.5  # ratio of `Road.size`, below which roads are similar


def alike(one: Road, other: Road) -> bool:
    """Whether two roads are geometrically similar: same kind, same numbers of lanes, arms and signals, and,
    if the kind has a `size`, a ratio of sizes below `ALIKE`."""
    if one.kind != other.kind or one.layout != other.layout:
        return False
    if one.size is None or other.size is None:
        return True
    return max(one.size, other.size) / min(one.size, other.size) < ALIKE


# ---- inside: XML ----


def _nodes(nodes: Mapping[str, tuple[float, float]], signals: Collection[str] = ()) -> str:
    lines = []
    for name, (x, y) in nodes.items():
        kind = "traffic_light" if name in signals else "priority"
        lines.append(f'    <node id="{name}" x="{x:.2f}" y="{y:.2f}" type="{kind}"/>')
    return _document("nodes", lines)


def _edges(*edges: str) -> str:
    return _document("edges", edges)


def _connections(*links: tuple[str, str, int, int]) -> str:
    lines = [
        f'    <connection from="{a}" to="{b}" fromLane="{lane}" toLane="{into}"/>'
        for a, b, lane, into in links
    ]
    return _document("connections", lines)


def _document(root: str, lines: Sequence[str]) -> str:
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', f"<{root}>", *lines, f"</{root}>", ""])


def _edge(
    name: str,
    begin: str,
    end: str,
    lanes: int,
    speed: float,
    rank: int = 3,
    shape: str = "",
    spread: str = "",
) -> str:
    words: dict[str, Any] = {"id": name, "from": begin, "to": end, "numLanes": lanes, "speed": f"{speed:g}"}
    words |= (
        {"priority": rank} | ({"spreadType": spread} if spread else {}) | ({"shape": shape} if shape else {})
    )
    return f"    <edge {' '.join(f'{key}={quoteattr(str(value))}' for key, value in words.items())}/>"


def _entry(name: str, begin: str, end: str, lanes: int, speed: float, shape: str) -> str:
    """An edge without lane changes."""
    opening = _edge(name, begin, end, lanes, speed, 3, shape, "right").removesuffix("/>") + ">"
    banned = [
        f'        <lane index="{k}"'
        + (' changeLeft="emergency"' if k < lanes - 1 else "")
        + (' changeRight="emergency"' if k else "")
        + "/>"
        for k in range(lanes)
    ]
    return "\n".join([opening, *banned, "    </edge>"])


def _straight(a: str, b: str, lanes: int) -> list[tuple[str, str, int, int]]:
    return [(a, b, lane, lane) for lane in range(lanes)]


def _ramp(start: float, lanes: int) -> str:
    """Shape of a ramp along its left edge, from x = `start` m to x = 0, beside the `lanes` of the road."""
    y = -LANE_WIDTH * lanes
    return (
        f"{start:g},{y - 60.0:g} {start * 0.6:g},{y - 30.0:g} {-PARALLEL_LENGTH - 60.0:g},{y - 4.0:g} "
        f"{-PARALLEL_LENGTH:g},{y:g} 0,{y:g}"
    )


def _mirrored(point: str, about: float) -> str:
    x, y = map(float, point.split(","))
    return f"{about - x:g},{y:g}"
