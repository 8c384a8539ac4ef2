"""Watches one episode from outside the loop: every vehicle's track, every decision and what became of it.

The watcher stands around the simulator and around the policy, passes everything through unchanged and
notes what it sees; the episode, and so its trace hash, is the same with it and without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.road import RoadMap
from cosim.scenario.behaviors import AS_IS
from cosim.types import (
    Collision,
    Command,
    Decision,
    Floats,
    Forecast,
    History,
    Ints,
    Kind,
    ObservationConfig,
    Policy,
    PolicyContext,
    Receipt,
    Simulator,
    Snapshot,
)

MOST = 400_000  # vehicle frames kept: about 2 MB of page; beyond, every second frame is given up


@dataclass(frozen=True)
class Track:
    """One vehicle's drive without a gap, k frames from frame `first` on."""

    id: str
    kind: Kind
    mission: bool
    driver: str  # an HV's class of Table II, or "as-is"; for drawing only
    length: float  # m
    width: float  # m
    first: int
    x: Floats  # [k] m, centre
    y: Floats  # [k] m
    heading: Floats  # [k] rad
    speed: Floats  # [k] m/s
    accel: Floats  # [k] m/s2
    lane: Ints  # [k] index into the road's lanes, -1 off every lane


@dataclass(frozen=True, slots=True)
class Choice:
    """What one AV decided, and what became of it."""

    decision: Decision
    target: float  # m/s, the speed commanded
    blocked: str | None  # why the command was not executed


@dataclass(frozen=True)
class Watched:
    """One episode as it was watched; times in s of simulation time."""

    facts: Mapping[str, Any]  # `cosim run --json`, filled in by whoever drew the result up
    road: RoadMap
    begin: float  # s, when the counted time began
    interval: float  # s between frames
    times: Floats  # [T] s
    tracks: tuple[Track, ...]
    decided: Floats  # [D] s, when decisions were taken
    choices: tuple[Mapping[str, Choice], ...]  # [D] AV -> choice
    forecasts: tuple[Forecast | None, ...]  # [D] what the policy predicted then
    collisions: tuple[Collision, ...]
    goal: frozenset[int] = frozenset()  # lanes on which the mission is fulfilled


@dataclass
class _Frame:
    """What is kept of a snapshot; arrays [n] in single precision (1 mm in 10 km)."""

    time: float
    slots: list[int]
    table: np.ndarray  # [n,6] x, y, heading, speed, accel, lane


@dataclass
class _Seen:
    """What does not change while a vehicle drives."""

    kind: Kind
    mission: bool
    length: float
    width: float


@dataclass
class Watcher:
    """Hand `simulator` and `policy` to an episode in place of those given here, then take `watched()`."""

    inner_simulator: Simulator
    inner_policy: Policy
    frames: list[_Frame] = field(default_factory=list)
    decided: list[float] = field(default_factory=list)
    choices: list[dict[str, Choice]] = field(default_factory=list)
    forecasts: list[Forecast | None] = field(default_factory=list)
    collisions: list[Collision] = field(default_factory=list)
    decisions: Mapping[str, Decision] = field(default_factory=dict)
    bodies: dict[str, _Seen] = field(default_factory=dict)
    slots: dict[str, int] = field(default_factory=dict)
    now: float = 0.0  # s
    stride: int = 1  # in frames: 2 keeps every other
    _frames_seen: int = 0
    _kept: int = 0

    @property
    def simulator(self) -> Simulator:
        """The simulator as it is, watched."""
        return _WatchedSimulator(self)

    @property
    def policy(self) -> Policy:
        """The policy as it is, watched."""
        return _WatchedPolicy(self)

    def watched(self, facts: Mapping[str, Any]) -> Watched:
        """Everything seen since the last reset; `facts` go beside it."""
        # only SUMO's simulator knows them
        classes: dict[str, str] = getattr(self.inner_simulator, "driver_classes", dict)()
        times = np.array([f.time for f in self.frames])
        return Watched(
            facts=facts,
            road=self.inner_simulator.road,
            begin=self.frames[0].time,
            interval=float(times[1] - times[0]) if len(times) > 1 else 0.0,
            times=times,
            tracks=tuple(self._tracks(classes)),
            decided=np.array(self.decided),
            choices=tuple(self.choices),
            forecasts=tuple(self.forecasts),
            collisions=tuple(self.collisions),
            goal=self.inner_simulator.goal_lanes,
        )

    def start(self, first: Snapshot) -> None:
        """A new episode whose clock begins with this frame."""
        self.frames, self.decided, self.choices, self.forecasts = [], [], [], []
        self.collisions, self.decisions = [], {}
        self.bodies, self.slots = {}, {}
        self.stride, self._frames_seen, self._kept = 1, 0, 0
        self.see(first)

    def see(self, snapshot: Snapshot) -> None:
        """One more frame."""
        s = snapshot
        self.now = s.time
        self.collisions += s.events.collisions
        for i, name in enumerate(s.ids):
            body = self.bodies.get(name)
            if body is None or body.mission != bool(s.mission[i]):
                self.bodies[name] = _Seen(
                    Kind(int(s.kind[i])), bool(s.mission[i]), float(s.length[i]), float(s.width[i])
                )
        self._frames_seen += 1
        if (self._frames_seen - 1) % self.stride:
            return
        slots = [self.slots.setdefault(name, len(self.slots)) for name in s.ids]
        columns = (s.x, s.y, s.heading, s.speed, s.accel, s.lane)
        self.frames.append(_Frame(s.time, slots, np.stack(columns, axis=1).astype(np.float32)))
        self._kept += s.n
        if self._kept > MOST and len(self.frames) > 2:
            self.frames = self.frames[::2]
            self.stride *= 2
            self._kept = sum(len(f.slots) for f in self.frames)
            kept = {f.time for f in self.frames}
            self.forecasts = [
                f if t in kept else None for t, f in zip(self.decided, self.forecasts, strict=True)
            ]

    def choose(self, decisions: Mapping[str, Decision]) -> None:
        """The policy has decided; what it predicted is asked for only here."""
        self.decisions = decisions
        self.decided.append(self.now)
        self.forecasts.append(getattr(self.inner_policy, "last_forecast", None) if decisions else None)

    def learn(self, commands: Sequence[Command], receipts: Sequence[Receipt]) -> None:
        """What became of the decisions."""
        self.choices.append(
            {
                c.vehicle: Choice(self.decisions[c.vehicle], c.target_speed, r.blocked)
                for c, r in zip(commands, receipts, strict=True)
            }
        )

    def _tracks(self, drivers: Mapping[str, str]) -> list[Track]:
        names = {slot: name for name, slot in self.slots.items()}
        rows: dict[int, list[tuple[int, np.ndarray]]] = {}
        for k, frame in enumerate(self.frames):
            for slot, row in zip(frame.slots, frame.table, strict=True):
                rows.setdefault(slot, []).append((k, row))
        found = []
        for slot, parts in rows.items():
            name = names[slot]
            body = self.bodies[name]
            driver = "" if body.kind == Kind.AV else drivers.get(name, AS_IS)
            at = np.array([k for k, _ in parts])
            table = np.stack([row for _, row in parts]).astype(np.float64)  # [k,6]
            for part in np.split(np.arange(len(at)), np.flatnonzero(np.diff(at) > 1) + 1):
                x, y, heading, speed, accel, lane = table[part].T
                found.append(
                    Track(
                        name, body.kind, body.mission, driver, body.length, body.width, int(at[part[0]]),
                        x, y, heading, speed, accel, lane.astype(np.int64),
                    )
                )  # fmt: skip
        return found


class _WatchedSimulator:
    """`cosim.types.Simulator`: the inner one, with a witness."""

    def __init__(self, watcher: Watcher) -> None:
        self._watcher, self._inner = watcher, watcher.inner_simulator
        self.road, self.goal_lanes = self._inner.road, self._inner.goal_lanes

    def reset(self, seed: int) -> tuple[Snapshot, ...]:
        frames = self._inner.reset(seed)
        self._watcher.start(frames[-1])
        return frames

    def advance(self, commands: Sequence[Command]) -> tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]:
        receipts, frames = self._inner.advance(commands)
        self._watcher.learn(commands, receipts)
        for frame in frames:
            self._watcher.see(frame)
        return receipts, frames

    def route(self, vehicle: str) -> tuple[str, ...]:
        return self._inner.route(vehicle)

    def commanded(self, vehicle: str) -> tuple[float | None, int]:
        return self._inner.commanded(vehicle)

    def counts(self) -> dict[str, int]:
        return self._inner.counts()

    def close(self) -> None:
        self._inner.close()


class _WatchedPolicy:
    """`cosim.types.Policy`: the inner one, with a witness."""

    def __init__(self, watcher: Watcher) -> None:
        self._watcher, self._inner = watcher, watcher.inner_policy
        self.name: str = self._inner.name
        self.label: str = self._inner.label
        self.observation: ObservationConfig = self._inner.observation
        self.av_parameters: Mapping[str, str] = self._inner.av_parameters

    def reset(self, context: PolicyContext) -> None:
        self._inner.reset(context)

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        decisions = self._inner.decide(histories)
        self._watcher.choose(decisions)
        return decisions
