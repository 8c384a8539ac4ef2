"""Data exchanged by packages: pure numpy, SI units, radians counter-clockwise from east, vehicle centres.

Letters in shapes: `n` vehicles, `N` past frames, `M` predicted frames, `C, H, W` map channels, rows
(across the road) and columns (along it), `R, F` kinematic rows and features, `A` = 5 meta-actions.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from cosim.arrays import Bools as Bools
from cosim.arrays import Bytes as Bytes
from cosim.arrays import Floats as Floats
from cosim.arrays import Floats32 as Floats32
from cosim.arrays import Ints as Ints
from cosim.errors import BadInput, in_range
from cosim.road import RoadMap, RouteAhead
from cosim.road.rules import NO_RULES, RulesAhead


class MetaAction(IntEnum):
    """The discrete meta-actions of paper P, equation (4), in its order."""

    LANE_LEFT = 0
    IDLE = 1
    LANE_RIGHT = 2
    ACCELERATE = 3
    DECELERATE = 4


LANE_OFFSET = {MetaAction.LANE_LEFT: 1, MetaAction.LANE_RIGHT: -1}  # as SUMO counts: left is up


class ContinuousAction(NamedTuple):
    """What an agent may ask of one AV in place of a meta-action, for one decision.

    Attributes:
        accel: m/s2, within the limits of the car (`cosim.control`) and, in `lawful`, of comfort and law.
        lane_offset: +1 begins a lane change to the left, -1 to the right, 0 none.
    """

    accel: float
    lane_offset: int = 0

    @property
    def lane_change(self) -> MetaAction:
        """The meta-action of the same lane change; IDLE without one."""
        return {1: MetaAction.LANE_LEFT, -1: MetaAction.LANE_RIGHT}.get(self.lane_offset, MetaAction.IDLE)


class Kind(IntEnum):
    """Who it is: a human-driven vehicle (HV), an autonomous one (AV), or a person on foot."""

    HV = 0
    AV = 1
    PERSON = 2


class Actor(IntEnum):
    """What it is, by SUMO's vehicle class."""

    CAR = 0
    TRUCK = 1
    BUS = 2
    MOTORCYCLE = 3
    BICYCLE = 4
    PERSON = 5
    OTHER = 6


class Preset:
    """What the car does whoever commands it (presets.md, Presets): every result names it."""

    LAWFUL = "lawful"  # the car keeps the law, comfortably, and brakes in an emergency
    UNGUARDED = "unguarded"  # commands are carried out within physical limits: the agent can crash
    GUARDED = "guarded"  # SUMO's own safety overrides commands
    ALL = (LAWFUL, UNGUARDED, GUARDED)


class OnCollision:
    """What a crash does to an episode (docs/reference/figures.md, Episode)."""

    END = "end"  # the episode ends
    CONTINUE = "continue"  # it goes on; the wrecks stand, and are taken off the road
    ALL = (END, CONTINUE)


class Traffic:
    """Whose SUMO options drive a user's file (formats.md, Traffic options): every result names it."""

    AS_IS = "as-is"  # the file's own: as plain SUMO drives it
    CONTROLLED = "controlled"  # with what AVs, other drivers and figures need, each change named
    ALL = (AS_IS, CONTROLLED)


INSERTION, INSIDE = "insertion", "junction"  # of `Collision.kind`


@dataclass(frozen=True, slots=True)
class Collision:
    """One pair of vehicles (or of a vehicle and a person) that touched, reported once per pair and episode.

    `source` is "sumo" (SUMO reported it) or "box" (only our oriented-box check saw it); `kind` is SUMO's word
    (collision, side, junction), "overlap" for ours, or `INSERTION`: SUMO had just put one onto the other.
    """

    time: float  # s
    collider: str
    victim: str
    collider_is_av: bool
    victim_is_av: bool
    kind: str
    source: str
    lane: str
    x: float  # m
    y: float  # m
    involves_mission: bool = False
    av_caused: bool = False  # an AV was the collider, or had just cut in
    # one of both, or the vehicle just ahead of one, was erring or had been shortly before (HumanError)
    human_error_involved: bool = False

    @property
    def insertion(self) -> bool:
        """Nobody's fault: it counts for nobody."""
        return self.kind == INSERTION

    @property
    def involves_av(self) -> bool:
        return not self.insertion and (self.collider_is_av or self.victim_is_av)

    @property
    def crash(self) -> bool:
        """Whether C% of the papers counts it: a collision of an AV or of the mission vehicle."""
        return self.involves_av or (self.involves_mission and not self.insertion)


@dataclass(frozen=True, slots=True)
class Overlap:
    """Two boxes that overlap without a collision, reported once per pair, circumstance and episode."""

    time: float  # s
    vehicles: tuple[str, str]
    circumstance: str  # of `cosim.simulation.collisions.CIRCUMSTANCES`: what brings it about


@dataclass(frozen=True, slots=True)
class Entry:
    """An AV's front bumper passed a stop line in this simulation step, or the end of the place behind it at
    which the net lets it wait inside the junction."""

    time: float  # s, the end of the step
    vehicle: str
    link: int  # index into RoadMap.links
    state: str  # the signal's in this step (rRyYgGosu), "" without a signal
    speed: float  # m/s
    least_speed: float  # m/s, over the last 10 m before the line
    yellow_since: float = -1.0  # s, when the signal turned yellow; -1 where it is not
    yellow_distance: float = 0.0  # m to the line and
    yellow_speed: float = 0.0  # m/s of the vehicle at that instant; inf if it was not on the road yet
    foes: tuple[tuple[str, int], ...] = ()  # who has the right of way within 100 m, each with its link
    inside: bool = False  # passed the place inside, not the line


@dataclass(frozen=True, slots=True)
class Offence:
    """What one AV did against the law, once for each that the figures count."""

    time: float  # s
    vehicle: str
    what: str  # in words, of which the vehicle is the subject


@dataclass(frozen=True, slots=True)
class Intervention:
    """The car began to drive otherwise than commanded (preset `lawful`)."""

    time: float  # s
    vehicle: str
    reason: str  # one of `cosim.control.REASONS`


REMEMBERED = 5.0  # s after its end in which a human error still has a part in a collision


@dataclass(frozen=True, slots=True)
class HumanError:
    """A human driver, or a person on foot, began to err (docs/explanation/driver_errors.md)."""

    time: float  # s
    who: str
    kind: str  # one of sumo_scenarios/errors.yaml
    until: float  # s, when it ends as planned
    what: str  # in words, of which the driver is the subject
    near: str = ""  # whom it meets first: the vehicle behind, beside or with the right of way

    def had_a_part(self, collision: Collision) -> bool:
        """Whether one of both erred or met who did, until the collision or `REMEMBERED` s before."""
        pair = collision.collider, collision.victim
        in_time = self.time <= collision.time <= self.until + REMEMBERED
        return in_time and (self.who in pair or self.near in pair)


class Due(NamedTuple):
    """A vehicle that is to depart and has found no room so far."""

    since: float  # s, its wished departure
    is_av: bool  # what it will be


@dataclass(frozen=True, slots=True)
class Events:
    """What happened since the last snapshot; ids in SUMO's order."""

    collisions: tuple[Collision, ...] = ()
    departed: tuple[str, ...] = ()
    arrived: tuple[str, ...] = ()
    teleported: tuple[str, ...] = ()
    emergency_stopped: tuple[str, ...] = ()
    entries: tuple[Entry, ...] = ()
    interventions: tuple[Intervention, ...] = ()
    depart_delays: tuple[float, ...] = ()  # s that each of `departed` waited to be inserted
    stopped: tuple[str, ...] = ()  # stand at a stop of their plan at the frame's end
    wrecked: tuple[str, ...] = ()  # crashed in an episode that goes on: they stand
    wrecks_removed: tuple[str, ...] = ()  # and were taken off the road
    errors: tuple[HumanError, ...] = ()
    overlaps: tuple[Overlap, ...] = ()

    @classmethod
    def of(cls, frames: Sequence[Snapshot]) -> Events:
        """What happened in all of `frames`, in their order."""
        every = [frame.events for frame in frames]
        return cls(**{f.name: tuple(x for e in every for x in getattr(e, f.name)) for f in fields(cls)})


NO_EVENTS = Events()


@dataclass(frozen=True)
class Snapshot:
    """Everybody on the road at one moment, sorted by id: vehicles and persons (`person:ID`).

        Shapes: all arrays [n], `signals` and `switches` [s]. Units: m, s, rad (counter-clockwise from
    east), m/s, m/s2.
    """

    time: float  # s
    ids: tuple[str, ...]
    kind: npt.NDArray[np.int8]  # [n] Kind
    mission: Bools  # [n] is a mission vehicle
    x: Floats  # [n] m, centre
    y: Floats  # [n] m, centre
    heading: Floats  # [n] rad
    speed: Floats  # [n] m/s
    accel: Floats  # [n] m/s2
    length: Floats  # [n] m
    width: Floats  # [n] m
    lane: npt.NDArray[np.int32]  # [n] index into RoadMap.lanes, -1 off every lane
    lane_position: Floats  # [n] m, of the front bumper along the lane
    events: Events = NO_EVENTS
    # [n] Actor; where nothing is given all are cars, persons apart
    actor: npt.NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8))
    # [n] for what can touch whom (`RoadMap.contact`): the lane; off every lane -2 - the edge's number in
    # `RoadMap.contact.edges`, -1 where that is not known. Where nothing is given: `lane`
    place: npt.NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    # [s] ord() of each state (rRyYgGosu), in the order of RoadMap.signals
    signals: Bytes = field(default_factory=lambda: np.zeros(0, np.uint8))
    # [s] s until the next phase of each signal's light, as it is planned now; empty in recordings
    switches: Floats = field(default_factory=lambda: np.zeros(0))
    # [n] s lost since departure against free flow (SUMO's timeLoss); nan where not known, as in recordings
    time_loss: Floats = field(default_factory=lambda: np.zeros(0))
    # [n] g/s of CO2 at this moment, by SUMO's emission model; nan where not known, as in recordings
    co2: Floats = field(default_factory=lambda: np.zeros(0))
    waiting: Mapping[str, Due] | None = None  # who is to depart and has found no room; None: not known
    # lane -> m/s where the limit is not the road's: variable speed signs, calibrators; none in recordings
    limits: Mapping[int, float] = field(default_factory=dict)
    # AV -> what it knows of all this; None: everything (ideal sensing)
    percepts: Mapping[str, Percept] | None = None

    def __post_init__(self) -> None:
        if len(self.actor) != len(self.kind):
            actor = np.where(self.kind == Kind.PERSON, Actor.PERSON, Actor.CAR).astype(np.int8)
            object.__setattr__(self, "actor", actor)
        if len(self.place) != len(self.lane):
            object.__setattr__(self, "place", self.lane)
        for name in ("time_loss", "co2"):
            if len(getattr(self, name)) != len(self.kind):
                object.__setattr__(self, name, np.full(len(self.kind), np.nan))

    @cached_property
    def row(self) -> dict[str, int]:
        """Vehicle id -> row in the arrays."""
        return {name: i for i, name in enumerate(self.ids)}

    @property
    def n(self) -> int:
        return len(self.ids)

    @cached_property
    def persons(self) -> npt.NDArray[np.intp]:
        """[p] rows of the persons."""
        return np.flatnonzero(self.kind == int(Kind.PERSON))

    @cached_property
    def vehicles(self) -> Snapshot:
        """The same without persons."""
        kept = np.flatnonzero(self.kind != int(Kind.PERSON))
        return self if len(kept) == self.n else self.only(kept)

    def only(self, rows: npt.NDArray[np.integer]) -> Snapshot:
        """The same with only these of its rows [k], in this order."""
        names = {f.name for f in fields(self)} - {"signals", "switches"}  # which have no row per vehicle
        columns = {name: getattr(self, name) for name in names}
        kept: dict[str, Any] = {k: v[rows] for k, v in columns.items() if isinstance(v, np.ndarray)}
        return replace(self, ids=tuple(self.ids[k] for k in rows), **kept)

    @property
    def avs(self) -> tuple[str, ...]:
        """Ids of the AVs."""
        return tuple(self.ids[row] for row in np.flatnonzero(self.kind == Kind.AV))


class Source(IntEnum):
    """What an AV's newest measurement of an object comes from."""

    TRUTH = 0  # ideal sensing, and the AV itself
    SENSOR = 1  # its own sensors
    CAM = 2  # a message of the object about itself (ETSI EN 302 637-2)
    CPM = 3  # a message of another AV whose sensors detected it (ETSI TS 103 324)


class Unseen(IntEnum):
    """Why an AV's own sensors do not detect an object in a frame."""

    OUT_OF_RANGE = 0  # or of the field of view
    HIDDEN = 1  # another vehicle's body or a building is in between
    MISSED = 2


@dataclass(frozen=True)
class Percept:
    """What one AV knows of the world at a frame (docs/reference/sensing.md).

    Attributes:
        world: the AV itself, as it is, and everybody it knows of, where it takes them to be; n in all.
        age: [n] s since the newest measurement of each.
        source: [n] `Source` of it.
        hears: the AVs whose intentions reach it in time for a decision (MCM).
        others: k vehicles and persons.
        detected: [k] whether the AV's own sensors detect each of them now (3), else `Unseen`.
    """

    world: Snapshot
    age: Floats
    source: npt.NDArray[np.int8]
    hears: frozenset[str]
    others: tuple[str, ...]
    detected: npt.NDArray[np.uint8]

    @cached_property
    def unseen(self) -> dict[str, Unseen]:
        """Vehicle or person -> why the AV's own sensors do not detect it, without those out of range."""
        within = (self.detected == Unseen.HIDDEN) | (self.detected == Unseen.MISSED)
        return {self.others[k]: Unseen(self.detected[k]) for k in np.flatnonzero(within).tolist()}


class Tracks(NamedTuple):
    """What AVs know of V vehicles and persons, each AV itself among those it knows of.

    An AV's own row is its state at the mean age of its tracks, so that its rows are of about one moment.
    """

    state: Floats  # [V,N,4] x m, y m, speed m/s, heading rad, a frame apart, newest at the measurement's time
    valid: Bools  # [V,N] whether it was known
    lane: Ints  # [V] index into `RoadMap.lanes`, -1 off every lane
    lane_position: Floats  # [V] m, front bumper along that lane
    length: Floats  # [V] m
    width: Floats  # [V] m
    is_av: Bools  # [V]
    is_mission: Bools  # [V]
    person: Bools  # [V]
    age: Floats  # [V] s since the newest measurement
    owner: Ints  # [V] the number of the AV whose knowledge it is


class Compensator(Protocol):
    """Predicts states that were measured a while ago to now, with a policy's predictor.

    Attributes:
        frames: N, how many past frames it is given.
    """

    frames: int

    def present(self, tracks: Tracks) -> Floats:
        """[V,4] x m, y m, speed m/s, heading rad of `tracks` now."""


# Columns of the kinematic matrix, in the ego's frame at the newest frame of the history
# (x ahead, y to the left), so that one history is in one fixed frame and series are smooth.
KINEMATIC_FEATURES = ("x", "y", "speed", "heading", "length", "width", "is_av", "is_mission")
X, Y, SPEED, HEADING, LENGTH, WIDTH, IS_AV, IS_MISSION = range(len(KINEMATIC_FEATURES))


NO_SIGNALS: Bytes = np.zeros(0, np.uint8)
NO_AGE: Floats = np.zeros(0)
NO_SOURCE: npt.NDArray[np.int8] = np.zeros(0, np.int8)


class History(NamedTuple):
    """What one AV knows at a decision: N frames, oldest first, and its own route.

    Rows follow the vehicle, not its rank: `ids[r]` names the vehicle of row r in every frame
    ("" for an empty row); `valid[k, r]` says whether it was on the road at frame k. Row 0 is the ego.
    """

    velocity_map: Bytes  # [N,C,H,W] pixel * 255; each in the ego's frame at its own time
    kinematics: Floats32  # [N,R,F] see KINEMATIC_FEATURES; m, m/s, rad (heading unwrapped)
    valid: Bools  # [N,R]
    ids: tuple[str, ...]  # R names, for explanation and V2V; never a network input
    lane: npt.NDArray[np.int32]  # [R] each vehicle's lane (map-matched), newest frame; -1 unknown
    lane_position: Floats  # [R] m, front bumper along that lane
    pose: Floats  # [3] the ego's x m, y m, heading rad in the world, at the newest frame
    target_speed: float  # m/s, the ego's present command (its speed while uncommanded)
    lane_changing: int  # +1 / -1 while a change to the left / right is under way, else 0
    route: RouteAhead  # lane centre lines ahead, dead ends, distance to the conflict zone
    time: float  # s
    rules: RulesAhead = NO_RULES  # signals, stop lines, right of way, crossings, limits on its own way
    signals: Bytes = NO_SIGNALS  # [s] `Snapshot.signals`, for drawing maps of what comes
    age: Floats = NO_AGE  # [R] s since the newest measurement of each row's vehicle; empty: all are 0
    source: npt.NDArray[np.int8] = NO_SOURCE  # [R] `Source` of that measurement; empty: all are the truth
    # the AVs whose intentions reach it in time for this decision (MCM); None: all, where they are shared
    hears: frozenset[str] | None = None
    decision_latency: float = 0.0  # s until what is decided now acts; the command before holds until then

    @property
    def ego_speed(self) -> float:
        """m/s at the newest frame."""
        return float(self.kinematics[-1, 0, 2])


class Decision(NamedTuple):
    """What a policy chose for one AV, with what is needed to explain it. A = 5 meta-actions.

    Attributes:
        action: the meta-action; with `accel`, the lane change alone.
        q: [A] action values.
        safety_score: [A] s, weighted time to collision (P, algorithm 2).
        unsafe: [A] whether the safety prioritizer refuses the action.
        ttc: [A] s until first contact under the action, capped.
        blamed: which vehicle made the preferred action unsafe, or another reason in brackets.
        vetoed: whether the preferred action was refused.
        fallback: whether every action was unsafe, and the highest score was taken.
        accel: m/s2, in place of a target speed.
    """

    action: MetaAction
    q: Floats32 | None = None
    safety_score: Floats32 | None = None
    unsafe: Bools | None = None
    ttc: Floats32 | None = None
    blamed: str | None = None
    vetoed: bool = False
    fallback: bool = False
    accel: float | None = None


class Forecast(NamedTuple):
    """What a policy expected of the vehicles it knew at its last decision: V vehicles, M frames ahead.

    A policy that predicts may keep one as `last_forecast`; replays draw it, nothing else reads it.
    """

    ids: tuple[str, ...]  # V
    x: Floats  # [V,M] m, vehicle centre
    y: Floats  # [V,M] m
    heading: Floats  # [V,M] rad
    along_std: Floats  # [V,M] m, standard deviation in driving direction; 0 where it is not known
    across_std: Floats  # [V,M] m
    interval: float  # s between frames; the first one lies one interval ahead


class Command(NamedTuple):
    """What one AV shall do until the next decision."""

    vehicle: str
    target_speed: float  # m/s
    lane_offset: int  # -1 right, 0 keep, +1 left
    hold: float  # s
    limit: float = (
        math.inf
    )  # m/s, the most that the law allows, as far as the agent sees it (preset `lawful`)
    accel: float | None = None  # m/s2, held until the next decision; `target_speed` is where it leads to


class Receipt(NamedTuple):
    """What became of a command: lane changes are never dropped silently."""

    vehicle: str
    executed: bool
    blocked: str | None = None  # why not


@dataclass(frozen=True, slots=True)
class ObservationConfig:
    """What an AV sees. The defaults are the compact size; `PAPER` is the papers'.

    Attributes:
        height: pixels of the map across the road.
        width: pixels along the road.
        metres_across: m per pixel.
        metres_along: m per pixel.
        channels: the map's channels, in their order.
        frames: N, past frames of 0.2 s.
        rows: R, the AV itself and up to 15 others.
        row_range: m, beyond which a vehicle gets no row.
        perception_range: m that an AV's own sensors reach.
        share_perception: whether AVs share what they perceive (V2V).
        maps: whether velocity maps are drawn.
        road_version: of the road channel; 2 draws the law too (stop lines, signals, crossings).
        signal_timing: whether an AV knows when the next signal switches.
    """

    height: int = 32
    width: int = 128
    metres_across: float = 1.0
    metres_along: float = 2.0
    channels: tuple[str, ...] = ("av", "hv", "road", "mission")
    frames: int = 10
    rows: int = 16
    row_range: float = 125.0
    perception_range: float = 125.0
    share_perception: bool = True
    maps: bool = True
    road_version: int = 1
    signal_timing: bool = False

    def __post_init__(self) -> None:
        """Raises BadInput when a size or a range is none, or the road channel's version is unknown."""
        if self.road_version not in (1, 2):
            raise BadInput("must be 1 or 2", field="road_version", value=self.road_version)
        sizes = "height width metres_across metres_along frames rows"
        in_range(self, positive=sizes, not_negative="row_range perception_range")


COMPACT = ObservationConfig()
PAPER = ObservationConfig(height=64, width=512, metres_across=0.5, metres_along=0.5)
SMOKE = ObservationConfig(height=16, metres_across=2.0)


@dataclass(frozen=True, slots=True)
class Timing:
    """The three clocks (contract): simulation step, frame, decision, all in s."""

    step: float = 0.1
    frame: float = 0.2
    decision: float = 0.4


@dataclass(frozen=True, slots=True)
class PolicyContext:
    """The circumstances of an episode, given to a policy when it starts."""

    road: RoadMap
    timing: Timing
    observation: ObservationConfig
    svo: float  # rad, the social value orientation phi
    rng: np.random.Generator
    preset: str = Preset.UNGUARDED
    # V2V: AVs pool what they know; not where each has a percept, which holds what messages told it
    share_perception: bool = True
    share_intentions: bool = True  # V2V: AVs decide front to back and know the choices before theirs

    @property
    def pooled(self) -> bool:
        """Whether AVs pool what they know."""
        return self.share_perception and self.observation.share_perception


class Policy(Protocol):
    """What commands the AVs. One object serves every AV of an episode.

    Attributes:
        name: what rows call it.
        observation: what it wants to see.
        av_parameters: SUMO's parameters of AVs that get no command.
        label: a warning that stands beside every result, for example "untrained"; or "".
    """

    name: str
    observation: ObservationConfig
    av_parameters: Mapping[str, str]
    label: str

    def reset(self, context: PolicyContext) -> None:
        """A new episode begins."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """One decision per AV to command; SUMO's IDM drives an AV that is left out."""


LookAhead = Callable[[int], Sequence[Snapshot]]  # so many frames ahead (`Simulator.ahead`)


@runtime_checkable
class LooksAhead(Protocol):
    """A policy that asks the simulation itself what will come: an oracle, a planner with a perfect model."""

    def looks_ahead(self, look: LookAhead) -> None:
        """`look(n)`, once an episode has begun: the next n frames (`Simulator.ahead`)."""


class Simulator(Protocol):
    """The world behind the loop: SUMO (`cosim.simulation.sumo`) or the in-memory fake."""

    road: RoadMap
    goal_lanes: frozenset[int]  # being on one of them fulfils the mission
    courtesy: float  # of commanded AVs in preset `lawful`, 0 to 1, set before the first `reset`

    def reset(self, seed: int) -> tuple[Snapshot, ...]:
        """Start the episode `seed` and drive its warm-up; the warm-up's last frames, newest last."""

    def advance(self, commands: Sequence[Command]) -> tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]:
        """Hold the commands for one decision; one snapshot per frame, the newest last."""

    def ahead(
        self, frames: int, commands: Sequence[Command] = (), *, errors: bool = False
    ) -> tuple[Snapshot, ...]:
        """What would come if the AVs went on as they are commanded, those of `commands` as these say; nothing
        changes. `errors`: whether human errors that have not begun may begin."""

    def route(self, vehicle: str) -> tuple[str, ...]:
        """The edges the vehicle still has to drive, its present edge first (own route knowledge)."""

    def commanded(self, vehicle: str) -> tuple[float | None, int]:
        """Present target speed in m/s (None while uncommanded) and lane change under way (+1, 0, -1)."""

    @property
    def tilted(self) -> tuple[float, Mapping[str, Sequence[float]]]:
        """Of this episode's errors: log(q / p), and what was tilted, case by case (estimate.md)."""

    def counts(self) -> dict[str, int]:
        """Vehicles since the start: `inserted`, and `waiting` ones that found no room so far."""

    def close(self) -> None:
        """End the simulation; safe to call twice."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure of a result with its unit and which direction is better ("higher", "lower", "")."""

    value: float | int | bool | None  # None is NA, never 0
    unit: str
    better: str


@dataclass(frozen=True)
class Identity:
    """What an episode is called in documents, rows, tables, recordings."""

    scenario: str
    demand: str
    policy: str
    policy_label: str | None  # e.g. "untrained"; None where it was never made
    behavior: str
    driver_model: str
    penetration: float | None  # share of AVs, where that chooses them
    preset: str
    errors: str | None = field(default=None, kw_only=True)  # a level, or a file's stem and digest; None: none
    sensing: str | None = field(
        default=None, kw_only=True
    )  # a level, a file, changed parameters; None: ideal
    svo_deg: float
    seed: int


IDENTITY = tuple(field.name for field in fields(Identity))
# Wall time, never repeatable: compilation of kernels counts in the total alone.
TIMINGS = ("compilation_s", "reset_s", "simulation_s", "observation_s", "decision_s", "total_s")
# What stands beside the figures in documents and rows: no figure may be called so.
MISSION = ("mission_vehicle", "mission_guessed")
WEIGHT = "weight"  # of an episode whose errors were drawn from tilted rates (docs/guides/estimate.md)
TILT = (WEIGHT, "log_ratio", "tilted", "tilt_trials")
RESERVED = {
    *IDENTITY,
    *TIMINGS,
    *MISSION,
    *TILT,
    "key",
    "cell",
    "status",
    "error",
    "stderr",
    "attempts",
    "steps",
} | {
    *("trace_hash", "timings", "comparable", "not_comparable_because", "collision_list"),
    *("interventions_by_reason", "human_errors_by_kind", "human_error_list"),
    *("units", "better", "manifest"),
}


@dataclass(frozen=True)
class EpisodeResult(Identity):
    """Everything one episode yields; `document()` is what `cosim run --json` prints."""

    steps: int  # decisions taken
    trace_hash: str
    metrics: dict[str, Metric]
    collisions: tuple[Collision, ...]
    timings: dict[str, float]  # s, by the names of `TIMINGS`
    validity: tuple[str, ...]  # reasons why the result is not comparable; empty when it is
    mission_vehicle: str | None = None  # its id (of several: joined by ", "); None: none was on the road
    mission_guessed: bool = False  # nobody named it: its figures feed no gate
    asked: dict[str, Any] = field(default_factory=dict)  # options that the identity does not say
    interventions_by_reason: dict[str, int] = field(default_factory=dict)  # the most frequent first
    errors_begun: tuple[HumanError, ...] = ()
    tilt: dict[str, Any] = field(default_factory=dict)  # by the names of `TILT`, of tilted errors
    manifest: dict[str, Any] = field(default_factory=dict)

    def value(self, name: str) -> float | int | bool | None:
        """The bare value of one metric."""
        return self.metrics[name].value

    def document(self) -> dict[str, Any]:
        """The JSON document of `cosim run --json`: metrics by name, their units beside them, NA null."""
        return {
            **{name: getattr(self, name) for name in IDENTITY},
            **self.asked,
            "steps": self.steps,
            **{name: getattr(self, name) for name in MISSION},
            **self.tilt,
            **{name: _plain(metric.value) for name, metric in self.metrics.items()},
            "trace_hash": self.trace_hash,
            "timings": {name: round(value, 6) for name, value in self.timings.items()},
            "comparable": not self.validity,
            "not_comparable_because": list(self.validity),
            "interventions_by_reason": dict(self.interventions_by_reason),
            "human_errors_by_kind": dict(Counter(e.kind for e in self.errors_begun).most_common()),
            "human_error_list": [[e.kind, e.who, round(e.time, 3)] for e in self.errors_begun],
            "collision_list": [{k: _plain(v) for k, v in asdict(c).items()} for c in self.collisions],
            "units": {name: metric.unit for name, metric in self.metrics.items()},
            "better": {name: metric.better for name, metric in self.metrics.items()},
            "manifest": self.manifest,
        }


def _plain(value: Any) -> Any:
    """The value as JSON holds it: Python's own number, None for one that is not finite."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
