"""The sensors, the radio and the tracker of every AV: snapshots in, percepts out.

Measurements are associated with tracks by the vehicle's id, for own sensors too. Association errors are not
modelled.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.arrays import Bools, Floats, Ints
from cosim.road import RoadMap
from cosim.scenario.sensing import Parameters
from cosim.seeding import subseed, uniform
from cosim.sensing import kernels
from cosim.sensing.kernels import (
    B_ACCEL,
    B_AGE,
    B_HEADING,
    B_INDICATOR,
    B_LANE,
    B_POSITION,
    B_SOURCE,
    B_SPEED,
    B_TOLD,
    B_X,
    B_Y,
    OWN,
)
from cosim.sensing.lanes import lane_lines
from cosim.sensing.walls import walls
from cosim.types import HEADING, Actor, Compensator, Kind, Percept, Snapshot, Source, Timing, Tracks, X, Y

COMPENSATION = {"hold": 0, "cv": 1, "lanes": 2, "truth": 3, "gp": 0, "hpn": 0}  # the kernels' part of it
PREDICTED = ("gp", "hpn")  # compensations with a `Compensator`
STATE = [B_X, B_Y, B_SPEED, B_HEADING]  # columns of a belief for a `Compensator`
PAST = [B_AGE, *STATE]  # columns kept for a `Compensator`, with the time in place of the age
HIDING = (Actor.CAR, Actor.TRUCK, Actor.BUS, Actor.OTHER)  # motorcycles and persons hide nothing
LONGEST_JITTER = 6.0  # times the mean jitter: one message in 400 is later and is ignored
NOBODY: frozenset[str] = frozenset()
AV, HV, PERSON = int(Kind.AV), int(Kind.HV), int(Kind.PERSON)  # plain ints: enum members are slow
TRUTH = int(Source.TRUTH)
SLOTS = 64  # initial capacity in objects; AVs: a quarter


class Perception:
    """One level of sensing in one episode; `perceive` once per frame, in order.

    Args:
        road: the net.
        parameters: the level.
        timing: the clocks.
        seed: of the episode and of every draw.
        compensator: for the compensations of `PREDICTED`.
        buildings: outlines [.,2] (m) that obstruct the line of sight.
    """

    def __init__(
        self,
        road: RoadMap,
        parameters: Parameters,
        timing: Timing,
        seed: int,
        compensator: Compensator | None = None,
        buildings: Sequence[Floats] = (),
    ) -> None:
        p = self._parameters = parameters
        if (compensator is None) != (p.compensation not in PREDICTED):
            raise ValueError(f"compensation {p.compensation} and {compensator} do not go together")
        self._compensator = compensator
        self._timing, self._seed = timing, seed
        self._lanes, outlines = lane_lines(road), walls(buildings)
        self._walls = outlines.begin, outlines.points, outlines.centre, outlines.radius
        self._noise = np.array([p.position_noise, p.speed_noise, math.radians(p.heading_noise)])
        heading = math.radians(p.cam_heading_noise)
        self._sender_noise = np.array([p.cam_position_noise, p.cam_speed_noise, heading])
        self._radio = p.message_range, p.period, p.delay, p.jitter, p.loss, p.burst
        self._contents = np.array([p.cam, p.cpm], np.uint8)
        self._lag = math.ceil(p.latency / timing.frame - 1e-6)
        oldest = max(p.delay + LONGEST_JITTER * p.jitter + p.period, p.forget) if p.cam or p.cpm else 0.0
        self._held, self._newest = 0, -1
        past = 0 if compensator is None else compensator.frames
        self._slots = _Slots(self._lag + math.ceil(oldest / timing.frame) + 3, past)

    def perceive(self, snapshot: Snapshot) -> Mapping[str, Percept]:
        """The percepts of every AV in the next frame."""
        p, slots, now = self._parameters, self._slots, snapshot.time
        rows = slots.settle(snapshot, self._stream, self._is_equipped)
        self._newest += 1
        self._held = min(self._held + 1, len(slots.ring))
        k = self._newest % len(slots.ring)
        state, seen = slots.ring[k], slots.seen[k]
        state[:] = np.nan
        columns = snapshot.x, snapshot.y, snapshot.heading, snapshot.speed, snapshot.lane
        state[rows] = np.stack([*columns, snapshot.lane_position, snapshot.indicator], axis=1)
        step = round(now / self._timing.frame)
        kernels.detect(
            *(state, slots.length, slots.width, slots.hides, slots.egos, slots.streams, step, p.range),
            *(math.radians(p.field_of_view) / 2.0, p.line_of_sight, p.visible_share, p.miss),
            *(self._walls, seen, slots.found[k]),
        )
        kernels.follow(
            *(slots.ring, slots.seen, slots.found, self._newest, self._held, slots.egos, slots.equipped),
            *(slots.streams, step, now, self._timing.frame, self._lag, self._noise, self._contents),
            *(self._radio, self._sender_noise, slots.tracks, slots.heard),
        )
        kernels.believe(
            *(state, slots.length, slots.egos, now, p.confirm, p.forget, COMPENSATION[p.compensation]),
            *self._lanes,
            *(slots.tracks, slots.first, slots.about, slots.beliefs),
        )
        about, beliefs = slots.about[: slots.first[-1]], slots.beliefs[: slots.first[-1]]
        if self._compensator is not None:
            self._compensate(self._compensator, about, beliefs, now)
        own = beliefs[:, B_SOURCE] == OWN
        slots.accel[rows] = snapshot.accel
        beliefs[own, B_ACCEL] = slots.accel[about[own]]
        hears = np.zeros((len(slots.egos), len(slots.egos)), np.uint8)
        if p.mcm:
            decision = self._timing.decision
            kernels.intentions_heard(state, slots.egos, slots.streams, now, decision, self._radio, hears)
        return Percepts(snapshot, slots, seen, about, beliefs, hears)

    # ---- inside ----

    def _compensate(self, compensator: Compensator, about: Ints, beliefs: Floats, now: float) -> None:
        """Predict all beliefs [M,11], of the slots `about` [M], to `now` (s)."""
        slots, past = self._slots, self._slots.past  # [N,A,S,5]
        then = self._own_then(beliefs)
        known = np.flatnonzero(then[:, B_SOURCE])
        owner = np.repeat(np.arange(len(slots.egos)), np.diff(slots.first))[known]
        place, then = about[known], then[known]  # [V], [V,11]
        past[:-1] = past[1:]
        past[-1] = np.nan
        past[-1, owner, place] = then[:, PAST]
        past[-1, ..., 0] = now - past[-1, ..., 0]
        late = (then[:, B_SOURCE] > 0.0) & (then[:, B_AGE] > 1e-6)
        if not late.any():
            return
        tracks = _tracks(slots, owner, place, then, self._timing.frame)
        present, then = compensator.present(tracks)[late], then[late]
        lane, position = then[:, B_LANE].astype(np.int64), then[:, B_POSITION].copy()
        position += np.hypot(present[:, X] - then[:, B_X], present[:, Y] - then[:, B_Y])
        kernels.drive_on(self._lanes.following, self._lanes.length, lane, position)
        then[:, STATE] = present
        then[:, B_LANE], then[:, B_POSITION] = lane, position
        beliefs[known[late]] = then

    def _own_then(self, beliefs: Floats) -> Floats:
        """`beliefs` [M,11] with each AV's own state at the mean age of its beliefs, in whole frames."""
        ring, frame, result = self._slots.ring, self._timing.frame, beliefs.copy()
        for a, e in enumerate(self._slots.egos):
            if e < 0:
                continue
            all_ = result[self._slots.first[a] : self._slots.first[a + 1]]
            source = all_[:, B_SOURCE]
            known, mine = source > 0.0, all_[(source == OWN).argmax()]
            age = float(all_[known, B_AGE].mean()) if known.any() else 0.0
            back = min(round(age / frame), self._held - 1)
            own = ring[(self._newest - back) % len(ring), e]
            mine[[B_X, B_Y, B_HEADING, B_SPEED, B_LANE, B_POSITION, B_INDICATOR]] = own
            mine[B_AGE] = back * frame
            if math.isnan(own[0]):
                mine[B_SOURCE] = 0.0
        return result

    def _stream(self, name: str) -> int:
        return subseed(self._seed, "sensing", name)

    def _is_equipped(self, name: str) -> bool:
        """Whether a human driver's vehicle sends CAMs."""
        return uniform(self._seed, "equipped", name) < self._parameters.equipped


class Known(NamedTuple):
    """Constant properties of the k objects with a slot, by name."""

    names: tuple[str, ...]
    place: Ints  # [k]
    length: Floats  # [k] m
    width: Floats  # [k] m
    kind: npt.NDArray[np.int8]  # [k]
    actor: npt.NDArray[np.int8]  # [k]
    mission: Bools  # [k]


class Percepts(Mapping[str, Percept]):
    """AV -> its percept at one frame, built on access."""

    def __init__(
        self,
        truth: Snapshot,
        slots: "_Slots",
        seen: npt.NDArray[np.uint8],  # [A,S]
        about: Ints,  # [M] slots
        beliefs: Floats,  # [M,11]
        hears: npt.NDArray[np.uint8],  # [A,A]
    ) -> None:
        known = slots.known
        rows, columns = np.empty(len(about), np.int64), np.empty((kernels.BELIEF, len(about)))
        kernels.arrange(slots.first, about, beliefs, known.place, len(slots.names), rows, columns)
        self._truth, self._others, self._avs = truth, known.names, dict(slots.avs)
        self._detected, self._hears = seen.take(known.place, 1), hears  # [A,k], [A,A]
        self._first, self._beliefs = slots.first.tolist(), columns
        self._names = {a: name for name, a in slots.avs.items()}
        self._ids = [*map(known.names.__getitem__, rows.tolist())]
        self._kind, self._actor = known.kind[rows], known.actor[rows]
        self._kind[(self._kind == AV) & (columns[B_TOLD] == 0.0)] = HV  # unknown as an AV without a CAM
        self._length, self._width, self._mission = known.length[rows], known.width[rows], known.mission[rows]
        self._lane = columns[B_LANE].astype(np.int32)
        self._indicator = columns[B_INDICATOR].astype(np.int8)
        self._source = np.maximum(columns[B_SOURCE], TRUTH).astype(np.int8)  # OWN is the truth
        self._unknown = np.full(len(rows), np.nan)
        self._found: dict[str, Percept] = {}

    def __getitem__(self, av: str) -> Percept:
        if av not in self._found:
            self._found[av] = self._percept(self._avs[av])
        return self._found[av]

    def __contains__(self, av: object) -> bool:
        return av in self._avs

    def __iter__(self) -> Iterator[str]:
        return iter(self._avs)

    def __len__(self) -> int:
        return len(self._avs)

    def _percept(self, a: int) -> Percept:
        truth, known = self._truth, slice(self._first[a], self._first[a + 1])
        b, lane, unknown = self._beliefs[:, known], self._lane[known], self._unknown[known]
        world = Snapshot(
            time=truth.time,
            ids=tuple(self._ids[known]),
            kind=self._kind[known],
            mission=self._mission[known],
            x=b[B_X],
            y=b[B_Y],
            heading=b[B_HEADING],
            speed=b[B_SPEED],
            accel=b[B_ACCEL],
            length=self._length[known],
            width=self._width[known],
            lane=lane,
            lane_position=b[B_POSITION],
            actor=self._actor[known],
            place=lane,
            signals=truth.signals,
            switches=truth.switches,
            time_loss=unknown,
            co2=unknown,
            indicator=self._indicator[known],
            limits=truth.limits,
        )
        heard = self._hears[a].nonzero()[0]
        hears = frozenset([self._names[k] for k in heard.tolist()]) if len(heard) else NOBODY
        return Percept(world, b[B_AGE], self._source[known], hears, self._others, self._detected[a])


def _tracks(slots: "_Slots", owner: Ints, place: Ints, then: Floats, frame: float) -> Tracks:
    """The beliefs `then` [V,11] of AVs and objects [V], with their past, `frame` s apart."""
    past = slots.past[:, owner, place].swapaxes(0, 1)  # [V,N,5]
    state = np.empty((*past.shape[:2], len(STATE)))
    turn = past[..., 1 + HEADING] - past[:, -1:, 1 + HEADING]
    past[..., 1 + HEADING] -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
    kernels.resample(past[..., 0], past[..., 1:], frame, state)
    return Tracks(
        state=state,
        valid=np.isfinite(state[..., X]),
        lane=then[:, B_LANE].astype(np.int64),
        lane_position=then[:, B_POSITION],
        length=slots.length[place],
        width=slots.width[place],
        is_av=(slots.kind[place] == AV) & (then[:, B_TOLD] > 0.0),
        is_mission=slots.mission[place],
        person=slots.kind[place] == PERSON,
        age=then[:, B_AGE],
        owner=owner,
    )


class _Slots:
    """Slots of objects and AVs in the arrays; an object keeps its slot while any AV tracks it."""

    def __init__(self, frames: int, past: int) -> None:
        self._past = past  # frames of beliefs for a `Compensator`
        self.names: list[str] = [""] * SLOTS  # "": free
        self.place: dict[str, int] = {}
        self.avs: dict[str, int] = {}
        self._allocate(frames, SLOTS, SLOTS // 4)
        self._ids: tuple[str, ...] = ()
        self._rows: Ints = np.zeros(0, np.int64)
        self.known = self._known()

    def _allocate(self, frames: int, objects: int, avs: int) -> None:
        self.ring = np.full((frames, objects, kernels.STATES), np.nan)
        self.seen = np.zeros((frames, avs, objects), np.uint8)
        self.found = np.full((frames, avs, objects), -1, np.int32)
        self.tracks = _no_tracks(avs, objects)
        self.first, self.about = np.zeros(avs + 1, np.int64), np.zeros(avs * objects, np.int64)
        self.beliefs = np.zeros((avs * objects, kernels.BELIEF))  # of the newest frame, as are these two
        self.past = np.full((self._past, avs, objects, len(PAST)), np.nan)
        self.heard = np.full((avs, avs), -1.0)
        self.egos = np.full(avs, -1, np.int64)
        self.length, self.width, self.accel = np.zeros(objects), np.zeros(objects), np.zeros(objects)
        self.kind, self.actor = np.zeros(objects, np.int8), np.zeros(objects, np.int8)
        self.mission = np.zeros(objects, np.bool_)
        self.hides, self.equipped = np.zeros(objects, np.uint8), np.zeros(objects, np.uint8)
        self.streams = np.zeros(objects, np.uint64)

    def settle(self, s: Snapshot, stream: Callable[[str], int], is_equipped: Callable[[str], bool]) -> Ints:
        """The slots [n] of the n vehicles and persons of the next frame."""
        if s.ids != self._ids or s.avs != tuple(self.avs):
            self._change(s, stream, is_equipped)
        if not np.array_equal(self.mission[self._rows], s.mission):
            self.mission[self._rows] = s.mission
            self.known = self._known()
        return self._rows

    def _change(self, s: Snapshot, stream: Callable[[str], int], is_equipped: Callable[[str], bool]) -> None:
        avs = set(s.avs)
        for name in [name for name in self.avs if name not in avs]:  # left, or no longer an AV
            self.egos[self.avs.pop(name)] = -1
        for name in [name for name in self.place if name not in s.row]:
            k = self.place[name]
            if np.isnan(self.tracks[:, k, kernels.T_TIME]).all():
                self.names[k] = ""
                del self.place[name]
                self._clear(k)
        new = [name for name in s.ids if name not in self.place]
        free = [k for k, name in enumerate(self.names) if not name]
        while len(free) < len(new):
            free += range(len(self.names), 2 * len(self.names))
            self._grow(2 * len(self.names), len(self.egos))
        for name, k in zip(new, free, strict=False):
            self._enter(name, k, s, stream, is_equipped)
        self._rows = np.array([self.place[name] for name in s.ids], np.int64)
        self._ids = s.ids
        for name in [name for name in s.avs if name not in self.avs]:
            self._equip(name)
        self.avs = {name: self.avs[name] for name in s.avs}
        self.mission[self._rows] = s.mission
        self.known = self._known()

    def _known(self) -> Known:
        names = tuple(sorted(self.place))
        k = np.array([self.place[name] for name in names], np.int64)
        fixed = self.length[k], self.width[k], self.kind[k], self.actor[k], self.mission[k]
        return Known(names, k, *fixed)

    def _enter(
        self, name: str, k: int, s: Snapshot, stream: Callable[[str], int], is_equipped: Callable[[str], bool]
    ) -> None:
        row = s.row[name]
        self.names[k], self.place[name] = name, k
        self.length[k], self.width[k] = s.length[row], s.width[row]
        self.kind[k], self.actor[k] = s.kind[row], s.actor[row]
        self.hides[k] = s.actor[row] in HIDING
        kind = s.kind[row]
        self.equipped[k] = kind == Kind.AV or (kind == Kind.HV and is_equipped(name))
        self.streams[k] = stream(name)

    def _clear(self, k: int) -> None:
        """Forget a slot's object, and the messages about it that are under way."""
        self.ring[:, k] = np.nan
        self.seen[:, :, k] = 0
        self.past[:, :, k] = np.nan
        self.tracks[:, k] = _no_tracks(1, 1)[0, 0]

    def _equip(self, name: str) -> None:
        """Register a vehicle as an AV."""
        free = np.flatnonzero(self.egos < 0)
        if not len(free):
            free = np.array([len(self.egos)])
            self._grow(len(self.names), 2 * len(self.egos))
        a, k = int(free[0]), self.place[name]
        self.avs[name], self.egos[a] = a, k
        self.kind[k], self.equipped[k] = Kind.AV, 1
        self.tracks[a] = _no_tracks(1, len(self.names))[0]
        self.seen[:, a] = 0
        self.past[:, a] = np.nan
        self.heard[a], self.heard[:, a] = -1.0, -1.0

    def _grow(self, objects: int, avs: int) -> None:
        before = dict(vars(self))
        n, b = len(self.names), len(self.egos)
        self._allocate(len(self.ring), objects, avs)
        self.names += [""] * (objects - n)
        for name in ("length", "width", "kind", "actor", "mission", "hides", "equipped", "streams"):
            getattr(self, name)[:n] = before[name]
        self.ring[:, :n] = before["ring"]
        self.seen[:, :b, :n] = before["seen"]
        self.found[:, :b, :n] = before["found"]
        self.tracks[:b, :n] = before["tracks"]
        self.past[:, :b, :n] = before["past"]
        self.heard[:b, :b] = before["heard"]
        self.egos[:b] = before["egos"]


def _no_tracks(avs: int, objects: int) -> Floats:
    """[A,S,19]"""
    tracks = np.full((avs, objects, kernels.TRACK), np.nan)
    tracks[..., kernels.T_CAM], tracks[..., kernels.T_TOLD] = -1.0, 0.0
    return tracks
