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


LANE_OFFSET = {MetaAction.LANE_LEFT: 1, MetaAction.LANE_RIGHT: -1}  # SUMO's sign convention: left is positive


class ContinuousAction(NamedTuple):
    """A continuous action of one AV for one decision, in place of a meta-action.

    Attributes:
        accel: m/s2, within the limits of the car (`cosim.control`) and, in `lawful`, of comfort and law.
        lane_offset: +1 begins a lane change to the left, -1 to the right, 0 none.
    """

    accel: float
    lane_offset: int = 0

    @property
    def decision(self) -> Decision:
        """The same with a meta-action for the lane change: IDLE without one."""
        offsets = {1: MetaAction.LANE_LEFT, -1: MetaAction.LANE_RIGHT}
        return Decision(offsets.get(self.lane_offset, MetaAction.IDLE), accel=self.accel)


class Kind(IntEnum):
    """The kind of an object: human-driven vehicle (HV), autonomous vehicle (AV), or person on foot."""

    HV = 0
    AV = 1
    PERSON = 2


class Actor(IntEnum):
    """The type of an object, by SUMO's vehicle class."""

    CAR = 0
    TRUCK = 1
    BUS = 2
    MOTORCYCLE = 3
    BICYCLE = 4
    PERSON = 5
    OTHER = 6


class Preset:
    """The car's own behaviour under any policy (presets.md, Presets); part of every result."""

    LAWFUL = "lawful"  # the car keeps the law, comfortably, and brakes in an emergency
    UNGUARDED = "unguarded"  # commands are carried out within physical limits: the agent can crash
    GUARDED = "guarded"  # SUMO's own safety overrides commands
    ALL = (LAWFUL, UNGUARDED, GUARDED)


class OnCollision:
    """The effect of a crash on an episode (docs/reference/figures.md, Episode)."""

    END = "end"  # the episode ends
    CONTINUE = "continue"  # the episode continues; wrecks stand, then are taken off the road
    ALL = (END, CONTINUE)


class Traffic:
    """The source of SUMO's options for a user's file (formats.md, Traffic options); part of every result."""

    AS_IS = "as-is"  # the file's own, as in plain SUMO
    CONTROLLED = "controlled"  # with the changes required by AVs, other drivers and figures, each named
    ALL = (AS_IS, CONTROLLED)


INSERTION, INSIDE = "insertion", "junction"  # of `Collision.kind`


@dataclass(frozen=True, slots=True)
class Collision:
    """One pair of vehicles (or of a vehicle and a person) that touched, reported once per pair and episode.

    `source` is "sumo" (reported by SUMO) or "box" (found by cosim's oriented-box check only). `kind`:
    SUMO's (collision, side, junction), "overlap" for cosim's, or `INSERTION`: SUMO inserted an overlap.
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
    # an error of either, or of the vehicle just ahead, was active now or shortly before (HumanError)
    human_error_involved: bool = False

    @property
    def insertion(self) -> bool:
        """Whether SUMO's insertion caused it: then it counts for no vehicle."""
        return self.kind == INSERTION

    @property
    def vehicles(self) -> tuple[str, ...]:
        """The vehicles (or persons) for which it counts."""
        return () if self.insertion else (self.collider, self.victim)

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
    circumstance: str  # the cause, one of `cosim.simulation.collisions.CIRCUMSTANCES`


@dataclass(frozen=True, slots=True)
class Entry:
    """An AV's front bumper passed a stop line in this simulation step, or the internal waiting position
    behind it."""

    time: float  # s, the end of the step
    vehicle: str
    link: int  # index into RoadMap.links
    state: str  # the signal's in this step (rRyYgGosu), "" without a signal
    speed: float  # m/s
    least_speed: float  # m/s, over the last 10 m before the line
    yellow_since: float = -1.0  # s, when the signal turned yellow; -1 if not yellow
    yellow_distance: float = 0.0  # m to the line and
    yellow_speed: float = 0.0  # m/s of the vehicle at that instant; inf if it was not on the road yet
    foes: tuple[tuple[str, int], ...] = ()  # vehicles with priority within 100 m, each with its link
    inside: bool = False  # passed the internal waiting position, not the line


@dataclass(frozen=True, slots=True)
class Offence:
    """One AV's violation of a traffic law, as counted in the figures."""

    time: float  # s
    vehicle: str
    what: str  # predicate of a sentence about the vehicle


@dataclass(frozen=True, slots=True)
class Intervention:
    """The car controller began to override the command (preset `lawful`)."""

    time: float  # s
    vehicle: str
    reason: str  # docs/reference/presets.md, Interventions


ERROR_MEMORY = 5.0  # s after its end during which a human error still counts as involved in a collision


@dataclass(frozen=True, slots=True)
class HumanError:
    """An error of a human driver or a person on foot began (docs/explanation/driver_errors.md)."""

    time: float  # s
    who: str
    kind: str  # one of sumo_scenarios/errors.yaml
    until: float  # s, planned end
    what: str  # predicate of a sentence about the driver
    near: str = ""  # the vehicle affected first: behind, beside or with priority

    def had_a_part(self, collision: Collision) -> bool:
        """Whether this error involved one of both, at the collision or up to `ERROR_MEMORY` s before."""
        pair = collision.collider, collision.victim
        in_time = self.time <= collision.time <= self.until + ERROR_MEMORY
        return in_time and (self.who in pair or self.near in pair)


class Due(NamedTuple):
    """A vehicle that is due to depart and waits for space."""

    since: float  # s, scheduled departure
    is_av: bool  # whether it will be an AV


@dataclass(frozen=True, slots=True)
class Events:
    """Events since the last snapshot; ids in SUMO's order."""

    collisions: tuple[Collision, ...] = ()
    departed: tuple[str, ...] = ()
    arrived: tuple[str, ...] = ()
    teleported: tuple[str, ...] = ()
    emergency_stopped: tuple[str, ...] = ()
    entries: tuple[Entry, ...] = ()
    interventions: tuple[Intervention, ...] = ()
    depart_delays: tuple[float, ...] = ()  # s, insertion delay of each of `departed`
    stopped: tuple[str, ...] = ()  # vehicles at a scheduled stop at the frame's end
    wrecked: tuple[str, ...] = ()  # crashed vehicles that stand while the episode continues
    wrecks_removed: tuple[str, ...] = ()  # wrecks taken off the road
    errors: tuple[HumanError, ...] = ()
    overlaps: tuple[Overlap, ...] = ()

    @classmethod
    def of(cls, frames: Sequence[Snapshot]) -> Events:
        """The events of all `frames`, in their order."""
        every = [frame.events for frame in frames]
        return cls(**{f.name: tuple(x for e in every for x in getattr(e, f.name)) for f in fields(cls)})


NO_EVENTS = Events()


@dataclass(frozen=True)
class Snapshot:
    """All vehicles and persons (`person:ID`) on the road at one moment, sorted by id.

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
    # [n] Actor; default: cars, and persons
    actor: npt.NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8))
    # [n] for possible contacts (`RoadMap.contact`): the lane; off every lane -2 - the edge's number in
    # `RoadMap.contact.edges`, -1 if unknown. Default: `lane`
    place: npt.NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    # [s] ord() of each state (rRyYgGosu), in the order of RoadMap.signals
    signals: Bytes = field(default_factory=lambda: np.zeros(0, np.uint8))
    # [s] s until the next phase of each signal, by the present plan; empty in recordings
    switches: Floats = field(default_factory=lambda: np.zeros(0))
    # [n] s lost since departure against free flow (SUMO's timeLoss); nan if unknown, as in recordings
    time_loss: Floats = field(default_factory=lambda: np.zeros(0))
    # [n] turn indicator: +1 left, -1 right, 0 off or unknown. SUMO's drivers set it as long as they want to
    # change lanes or turn
    indicator: npt.NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8))
    # [n] g/s of CO2 at this moment, by SUMO's emission model; nan if unknown, as in recordings
    co2: Floats = field(default_factory=lambda: np.zeros(0))
    waiting: Mapping[str, Due] | None = None  # vehicles waiting for insertion; None: unknown
    # lane -> m/s where the limit differs from the road's: variable signs, calibrators; none in recordings
    limits: Mapping[int, float] = field(default_factory=dict)
    # AV -> its percept; None: ideal sensing
    percepts: Mapping[str, Percept] | None = None

    def __post_init__(self) -> None:
        if len(self.actor) != len(self.kind):
            actor = np.where(self.kind == Kind.PERSON, Actor.PERSON, Actor.CAR).astype(np.int8)
            object.__setattr__(self, "actor", actor)
        if len(self.place) != len(self.lane):
            object.__setattr__(self, "place", self.lane)
        if len(self.indicator) != len(self.kind):
            object.__setattr__(self, "indicator", np.zeros(len(self.kind), np.int8))
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
        """The snapshot without persons."""
        kept = np.flatnonzero(self.kind != int(Kind.PERSON))
        return self if len(kept) == self.n else self.only(kept)

    def only(self, rows: npt.NDArray[np.integer]) -> Snapshot:
        """The snapshot restricted to these rows [k], in this order."""
        names = {f.name for f in fields(self)} - {"signals", "switches"}  # these have no row per vehicle
        columns = {name: getattr(self, name) for name in names}
        kept: dict[str, Any] = {k: v[rows] for k, v in columns.items() if isinstance(v, np.ndarray)}
        return replace(self, ids=tuple(self.ids[k] for k in rows), **kept)

    @property
    def avs(self) -> tuple[str, ...]:
        """Ids of the AVs."""
        return tuple(self.ids[row] for row in np.flatnonzero(self.kind == Kind.AV))


class Source(IntEnum):
    """The source of an AV's newest measurement of an object."""

    TRUTH = 0  # ideal sensing, and the AV itself
    SENSOR = 1  # its own sensors
    CAM = 2  # an object's message about itself (ETSI EN 302 637-2)
    CPM = 3  # a message of another AV that detected the object (ETSI TS 103 324)


class Unseen(IntEnum):
    """The reason why an AV's own sensors do not detect an object in a frame."""

    OUT_OF_RANGE = 0  # or outside the field of view
    HIDDEN = 1  # behind another vehicle's body or a building
    MISSED = 2


@dataclass(frozen=True)
class Percept:
    """One AV's knowledge of the traffic at a frame (docs/reference/sensing.md).

    Attributes:
        world: the true state of the AV itself, and the estimated states of all known objects; n in all.
        age: [n] s since the newest measurement of each.
        source: [n] `Source` of that measurement.
        hears: the AVs whose intentions arrive in time for a decision (MCM).
        others: k vehicles and persons.
        detected: [k] whether the AV's own sensors detect each of `others` now (3), else `Unseen`.
    """

    world: Snapshot
    age: Floats
    source: npt.NDArray[np.int8]
    hears: frozenset[str]
    others: tuple[str, ...]
    detected: npt.NDArray[np.uint8]

    @cached_property
    def unseen(self) -> dict[str, Unseen]:
        """Vehicle or person in range -> reason why the AV's own sensors do not detect it."""
        within = (self.detected == Unseen.HIDDEN) | (self.detected == Unseen.MISSED)
        return {self.others[k]: Unseen(self.detected[k]) for k in np.flatnonzero(within).tolist()}


class Tracks(NamedTuple):
    """The AVs' tracks of V vehicles and persons; every AV also tracks itself.

    An AV's own row is its state at the mean age of its tracks, so that all its rows are of about one moment.
    """

    state: Floats  # [V,N,4] x m, y m, speed m/s, heading rad, a frame apart, newest at the measurement's time
    valid: Bools  # [V,N] known in that frame
    lane: Ints  # [V] index into `RoadMap.lanes`, -1 off every lane
    lane_position: Floats  # [V] m, front bumper along that lane
    length: Floats  # [V] m
    width: Floats  # [V] m
    is_av: Bools  # [V]
    is_mission: Bools  # [V]
    person: Bools  # [V]
    age: Floats  # [V] s since the newest measurement
    owner: Ints  # [V] number of the AV that owns the track


class Compensator(Protocol):
    """Delay compensation: predicts late states to now with a policy's predictor.

    Attributes:
        frames: N, number of past frames in its input.
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
    """One AV's observation at a decision: N frames, oldest first, and its own route.

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
    target_speed: float  # m/s, the ego's present command (while uncommanded its speed, in `lawful` the limit)
    lane_changing: int  # +1 / -1 while a change to the left / right is under way, else 0
    route: RouteAhead  # lane centre lines ahead, dead ends, distance to the conflict zone
    time: float  # s
    rules: RulesAhead = NO_RULES  # signals, stop lines, right of way, crossings, limits on its own way
    signals: Bytes = NO_SIGNALS  # [s] `Snapshot.signals`, for drawing predicted maps
    age: Floats = NO_AGE  # [R] s since the newest measurement of each row's vehicle; empty: all are 0
    source: npt.NDArray[np.int8] = NO_SOURCE  # [R] `Source` of that measurement; empty: all are the truth
    indicator: npt.NDArray[np.int8] = NO_SOURCE  # [R] `Snapshot.indicator`; empty: unknown
    # the AVs whose intentions arrive in time for this decision (MCM); None: all, if intentions are shared
    hears: frozenset[str] | None = None
    decision_latency: float = 0.0  # s until this decision acts; the previous command holds until then

    @property
    def ego_speed(self) -> float:
        """m/s at the newest frame."""
        return float(self.kinematics[-1, 0, 2])


class Decision(NamedTuple):
    """A policy's choice for one AV, with its explanation. A = 5 meta-actions.

    Attributes:
        action: the meta-action; with `accel`, the lane change alone.
        q: [A] action values.
        safety_score: [A] s, weighted time to collision (P, algorithm 2).
        unsafe: [A] whether the safety prioritizer refuses the action.
        ttc: [A] s until first contact under the action, capped.
        blamed: the vehicle that made the preferred action unsafe, or another reason in brackets.
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
    """A policy's prediction at its last decision: V known vehicles, M frames ahead.

    A policy may expose one as `last_forecast`, which is used by replays only.
    """

    ids: tuple[str, ...]  # V
    x: Floats  # [V,M] m, vehicle centre
    y: Floats  # [V,M] m
    heading: Floats  # [V,M] rad
    along_std: Floats  # [V,M] m, standard deviation in driving direction; 0 if unknown
    across_std: Floats  # [V,M] m
    interval: float  # s between frames; the first one lies one interval ahead


class Command(NamedTuple):
    """One AV's command until the next decision."""

    vehicle: str
    target_speed: float  # m/s
    lane_offset: int  # -1 right, 0 keep, +1 left
    hold: float  # s
    limit: float = math.inf  # m/s, highest lawful speed known to the agent (preset `lawful`)
    accel: float | None = None  # m/s2, held until the next decision; `target_speed` is the resulting speed


class Receipt(NamedTuple):
    """The outcome of a command: lane changes are never dropped silently."""

    vehicle: str
    executed: bool
    blocked: str | None = None  # reason if not executed


@dataclass(frozen=True, slots=True)
class ObservationConfig:
    """The observation of an AV. The defaults are the compact size; `PAPER` is the papers'.

    Attributes:
        height: pixels of the map across the road.
        width: pixels along the road.
        metres_across: m per pixel.
        metres_along: m per pixel.
        channels: the map's channels, in their order.
        frames: N, past frames of 0.2 s.
        rows: R, the AV itself and up to 15 others.
        row_range: m, beyond which a vehicle gets no row.
        perception_range: m, range of an AV's own sensors.
        share_perception: whether AVs share their perception (V2V).
        maps: whether velocity maps are drawn.
        road_version: of the road channel; 2 draws the law too (stop lines, signals, crossings).
        signal_timing: whether an AV knows the next signal's switching time.
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
        """Raises BadInput for an invalid size or range, or an unknown version of the road channel."""
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
    """The context of an episode, given to a policy at its start."""

    road: RoadMap
    timing: Timing
    observation: ObservationConfig
    svo: float  # rad, the social value orientation phi
    rng: np.random.Generator
    preset: str = Preset.UNGUARDED
    # V2V: AVs pool their knowledge; not with percepts, which contain received messages already
    share_perception: bool = True
    share_intentions: bool = True  # V2V: AVs decide front to back and know the choices before theirs

    @property
    def pooled(self) -> bool:
        """Whether AVs pool their knowledge."""
        return self.share_perception and self.observation.share_perception


class Policy(Protocol):
    """A policy commands the AVs. One object serves every AV of an episode.

    Attributes:
        name: the policy's name in rows.
        observation: the observation that it needs.
        av_parameters: SUMO's parameters of AVs without a command.
        label: a warning beside every result, for example "untrained"; or "".
    """

    name: str
    observation: ObservationConfig
    av_parameters: Mapping[str, str]
    label: str

    def reset(self, context: PolicyContext) -> None:
        """Start an episode."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """One decision per AV to command; SUMO drives an AV without a decision: by IDM, in `lawful` after an
        earlier decision by the car's Krauss driver."""


LookAhead = Callable[[int], Sequence[Snapshot]]  # number of frames -> future snapshots (`Simulator.ahead`)


@runtime_checkable
class LooksAhead(Protocol):
    """A policy that reads the simulation's future: an oracle, or a planner with a perfect model."""

    def looks_ahead(self, look: LookAhead) -> None:
        """Receive `look(n)`, valid during an episode: the next n frames (`Simulator.ahead`)."""


class Simulator(Protocol):
    """The simulator of the loop: SUMO (`cosim.simulation.sumo`) or the in-memory fake."""

    road: RoadMap
    goal_lanes: frozenset[int]  # lanes on which the mission is fulfilled
    courtesy: float  # of commanded AVs in preset `lawful`, 0 to 1, set before the first `reset`

    def reset(self, seed: int) -> tuple[Snapshot, ...]:
        """Start the episode `seed`, drive its warm-up and return its last frames, newest last."""

    def advance(self, commands: Sequence[Command]) -> tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]:
        """Hold the commands for one decision; one snapshot per frame, the newest last."""

    def ahead(self, frames: int, commands: Sequence[Command] = ()) -> tuple[Snapshot, ...]:
        """A counterfactual rollout with the AVs' present commands, replaced by `commands` where given; the
        simulation itself does not change. No new human errors begin."""

    def route(self, vehicle: str) -> tuple[str, ...]:
        """The remaining edges of the vehicle's route, its present edge first."""

    def commanded(self, vehicle: str) -> tuple[float | None, int]:
        """Present target speed in m/s, and the lane change under way (+1, 0, -1).

        While uncommanded the target is None, in `lawful` the speed limit.
        """

    @property
    def tilted(self) -> tuple[float, Mapping[str, Sequence[float]]]:
        """Importance weight of this episode's errors: log(q / p), and each tilted draw (estimate.md)."""

    def counts(self) -> dict[str, int]:
        """Vehicles since the start: `inserted`, and those still `waiting` for insertion."""

    def close(self) -> None:
        """End the simulation; safe to call twice."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure of a result with its unit and its better direction ("higher", "lower", "")."""

    value: float | int | bool | None  # None is NA, never 0
    unit: str
    better: str


@dataclass(frozen=True)
class Identity:
    """The identity of an episode in documents, rows, tables, recordings."""

    scenario: str
    demand: str
    policy: str
    policy_label: str | None  # e.g. "untrained"; None if the policy was never built
    behavior: str
    driver_model: str
    penetration: float | None  # share of AVs, if the fleet is chosen by share
    preset: str
    errors: str | None = field(default=None, kw_only=True)  # a level, or a file's stem and digest; None: none
    sensing: str | None = field(
        default=None, kw_only=True
    )  # a level, a file, changed parameters; None: ideal
    svo_deg: float
    seed: int


IDENTITY = tuple(field.name for field in fields(Identity))
# Wall time, not reproducible; compilation of kernels counts in the total only.
TIMINGS = ("compilation_s", "reset_s", "simulation_s", "observation_s", "decision_s", "total_s")
# Other fields of documents and rows, reserved: no figure may have these names.
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
    """The result of one episode; `document()` is the output of `cosim run --json`."""

    steps: int  # decisions taken
    trace_hash: str
    metrics: dict[str, Metric]
    collisions: tuple[Collision, ...]
    timings: dict[str, float]  # s, by the names of `TIMINGS`
    validity: tuple[str, ...]  # reasons why the result is not comparable; empty if it is
    mission_vehicle: str | None = None  # its id (several: joined by ", "); None: none was on the road
    mission_guessed: bool = False  # chosen automatically: its figures are excluded from gates
    asked: dict[str, Any] = field(default_factory=dict)  # options outside of the identity
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
    """The value for JSON: a Python number, None if not finite."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
