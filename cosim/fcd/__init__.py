"""The metrics of an episode, computed for a user's floating-car data (SUMO's fcd-output)."""

import itertools
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import BadInput
from cosim.fcd.encounters import Encounters, edge_of
from cosim.fcd.file import Row, Step, lanes_named, read_steps
from cosim.fcd.vehicle_types import DEFAULT, Size, size_of
from cosim.files.xml_input import Progress
from cosim.metrics import METRICS, MetricContext
from cosim.metrics.post_encroachment import MAX_PET
from cosim.road import Lane, RoadMap
from cosim.simulation.conventions import OURS, centres, type_names
from cosim.types import Kind, Metric, Snapshot, Timing

FIGURES = ("time_to_collision", "post_encroachment", "drac", "hard_braking", "jerk", "headway", "exposure")
CONFLICTS = ("time_to_collision", "drac")  # single-frame figures, which a lane jump would falsify
MAX_LATERAL_SPEED = 2.5  # m/s; a faster lateral move is a lane change of SUMO that takes no time
MAX_TURN = math.radians(5.0)  # a larger change of heading explains a lateral move by a bend
MIN_LATERAL_JUMP = 2.5  # m to another edge; less is an offset between the lanes of the two edges
SETTLING_TIME = 2.0  # s, usual duration of a lane change: conflicts in it are an artefact of the jump
FRAME = Timing().frame  # s; finer data are thinned, so that figures compare with an episode's
MIN_CHECK_DISTANCE = 200.0  # m driven by all vehicles before the check of the positions
UNKNOWN_LENGTH = 1e6  # m, of a lane without a known length


@dataclass(frozen=True, slots=True)
class Roles:
    """The vehicles with counted conflicts, braking, jerk and headways: by default all."""

    av_type: str | None = None  # a vType; `cosim.`: every AV in an output of a cosim run
    av_ids: re.Pattern[str] | None = None  # full match
    mission: re.Pattern[str] | None = None  # full match

    @property
    def everybody(self) -> bool:
        return self.av_type is None and self.av_ids is None and self.mission is None

    def kind(self, vehicle: str, vehicle_type: str) -> tuple[Kind, bool]:
        """(AV or HV, is a mission vehicle), by the rules of `cosim run`."""
        if self.everybody:
            return Kind.AV, False
        if self.mission is not None and self.mission.fullmatch(vehicle):
            return Kind.HV, True
        ours = self.av_type == OURS and vehicle_type.startswith(OURS)
        is_av = ours or self.av_type in type_names(vehicle_type)
        if self.av_ids is not None:
            is_av = self.av_ids.fullmatch(vehicle) is not None
        return (Kind.AV if is_av else Kind.HV), False


@dataclass(frozen=True)
class Analysis:
    """The figures of one file."""

    figures: Mapping[str, Metric]
    begin: float  # s, first counted frame
    end: float  # s, last counted frame
    interval: float  # s between counted frames
    frames: int
    vehicles: int
    watched: int
    notes: tuple[str, ...]  # assumptions, and data missing in the file
    encounters: tuple[Mapping[str, Any], ...] = ()  # `Encounters.found`, on request


def analyse(
    path: Path,
    *,
    road: RoadMap | None = None,
    sizes: Mapping[str, Size] | None = None,
    roles: Roles = Roles(),
    begin: float = -math.inf,
    end: float = math.inf,
    frame: float | None = None,
    critical: float | None = None,
    progress: Progress | None = None,
) -> Analysis:
    """Read the file once, as a stream. `begin`, `end` in s; `frame`: s between counted frames. `critical`:
    list the encounters with a smaller time to collision (s).

    Without a `road`, vehicles on and below a bridge are not distinguished, and headways end with the lane.

    Raises:
        BadInput: malformed or truncated, not FCD, a number missing or not finite, a vehicle twice in a step,
            times that do not increase evenly, positions in degrees, no vehicle at all.
    """
    lanes = road or _loose_lanes(path)
    encounters = None if critical is None else Encounters(lanes, critical)
    counter = _Counter(path, lanes, dict(sizes or {}), roles, (begin, end), frame, encounters)
    read_steps(path, counter.see, progress)
    return counter.finish(road is not None, sizes is not None)


def _loose_lanes(path: Path) -> RoadMap:
    """The lanes named in the file, without connections; vehicles on any two lanes may touch."""
    shape = np.array([[0.0, 0.0], [1.0, 0.0]])
    return RoadMap(tuple(Lane(name, "", 0, shape, UNKNOWN_LENGTH, 3.2, 0.0) for name in lanes_named(path)))


class _Counter:
    """Turns steps into snapshots and feeds them to the metrics."""

    def __init__(
        self,
        path: Path,
        road: RoadMap,
        sizes: dict[str, Size],
        roles: Roles,
        window: tuple[float, float],
        frame: float | None,
        encounters: Encounters | None,
    ) -> None:
        self._path, self._road, self._sizes, self._roles = path, road, sizes, roles
        self._begin, self._end = window
        self._wanted = frame
        self._metrics = {name: METRICS[name]() for name in FIGURES}
        self._encounters = encounters
        self._first: Step | None = None  # kept until the second step gives the interval
        self._interval = 0.0  # s between the file's steps
        self._stride = 1  # steps per frame
        self._index = 0  # of the last step
        self._time = 0.0  # s, of the last step
        self._newest: Snapshot | None = None
        self._frames = 0
        self._began = math.nan  # s, of the first frame
        self._known: dict[str, tuple[str, Kind, bool, Size]] = {}  # id -> type, kind, mission, size
        self._unknown_types: set[str] = set()
        self._laneless = self._rows = 0  # vehicle frames
        self._unknown_lanes: Counter[str] = Counter()  # lanes that the road lacks
        self._jumps = 0  # lane changes between two frames
        self._jumped: dict[str, float] = {}  # vehicle -> s of the last jump, within `SETTLING_TIME`
        self._driven = self._moved = 0.0  # m, by the speeds and by the positions

    def see(self, step: Step) -> None:
        """The next step of the file."""
        if not self._begin - 1e-9 <= step.time <= self._end + 1e-9:
            return
        if self._first is None and not self._frames:
            self._first = step
            return
        if self._first is not None:
            first, self._first = self._first, None
            self._set_clock(step.time - first.time, first.time)
            self._count(self._snapshot(first))
        self._advance(step)

    def _set_clock(self, interval: float, first: float) -> None:
        """Set the interval of the file from its first two steps."""
        if interval <= 1e-9:
            raise self._wrong("times must increase", "timestep.time", f"{first + interval:g}")
        self._interval = interval = round(interval, 9)
        wanted = self._wanted if self._wanted is not None else max(FRAME, interval)
        ratio = wanted / interval
        if abs(ratio - round(ratio)) > 1e-6:
            if self._wanted is not None:
                problem = f"must be a whole number of the file's steps of {interval:g} s"
                raise BadInput(problem, field="--frame", value=f"{wanted:g}")
            ratio = 1.0  # 0.2 s is no multiple: use the file's steps
        self._stride = max(round(ratio), 1)
        timing = Timing(interval, self._stride * interval, self._stride * interval)
        self._context = MetricContext(self._road, timing, "none", frozenset(), math.inf)
        self._time = first

    def _advance(self, step: Step) -> None:
        passed = (step.time - self._time) / self._interval
        if passed < 0.5:
            raise self._wrong("times must increase", "timestep.time", f"{step.time:g}")
        if abs(passed - round(passed)) > 0.01 * max(passed, 1.0):
            apart = step.time - self._time
            problem = f"steps are not evenly spaced: {self._interval:g} s at first, then {apart:g} s"
            raise self._wrong(problem, "timestep.time", f"{step.time:g}")
        skipped = range(self._index + 1, self._index + round(passed))
        self._index += round(passed)
        # the file may omit steps without vehicles: add empty ones, as far back as any metric remembers
        for k in list(skipped)[-math.ceil(MAX_PET / self._interval) - 1 :]:
            if k % self._stride == 0:
                empty = Step(step.time - (self._index - k) * self._interval)
                self._count(self._snapshot(empty))
        self._time = step.time
        if self._index % self._stride == 0:
            self._count(self._snapshot(step))

    def _snapshot(self, step: Step) -> Snapshot:
        rows = [step.rows[name] for name in sorted(step.rows)]
        known = [self._identify(row) for row in rows]
        length = np.array([k[3].length for k in known], np.float64)  # [n] m
        table = np.array([(r.x, r.y, r.angle, r.speed) for r in rows], np.float64).reshape(-1, 4)
        x, y, heading = centres(table[:, 0], table[:, 1], table[:, 2], 0.5 * length)
        index = self._road.index
        self._laneless += sum(math.isnan(r.pos) for r in rows)
        self._rows += len(rows)
        self._unknown_lanes.update(r.lane for r in rows if not math.isnan(r.pos) and r.lane not in index)
        return Snapshot(
            time=step.time,
            ids=tuple(r.id for r in rows),
            kind=np.array([k[1] for k in known], np.int8),
            mission=np.array([k[2] for k in known], np.bool_),
            x=x,
            y=y,
            heading=heading,
            speed=table[:, 3].copy(),
            accel=np.zeros(len(rows)),  # the metrics derive accelerations from the speeds
            length=length,
            width=np.array([k[3].width for k in known], np.float64),
            lane=np.array([-1 if math.isnan(r.pos) else index.get(r.lane, -1) for r in rows], np.int32),
            lane_position=np.array([r.pos for r in rows], np.float64),
        )

    def _identify(self, row: Row) -> tuple[str, Kind, bool, Size]:
        known = self._known.get(row.id)
        if known is None or known[0] != row.type:
            size = size_of(row.type, self._sizes)
            if size is None:
                self._unknown_types.add(row.type)
                size = DEFAULT
            known = self._known[row.id] = (row.type, *self._roles.kind(row.id, row.type), size)
        return known

    def _count(self, snapshot: Snapshot) -> None:
        self._note_jumps(snapshot)
        seen = self._settled(snapshot)
        for name, metric in self._metrics.items():
            frame = seen if name in CONFLICTS else snapshot
            if self._frames:
                metric.add(frame)
            else:
                metric.reset(frame, self._context)
        if self._encounters is not None:
            self._encounters.add(snapshot, self._jumped)
        if self._newest is None:
            self._began = snapshot.time
        elif self._driven < MIN_CHECK_DISTANCE:
            self._check_positions(self._newest, snapshot)
        self._frames += 1
        self._newest = snapshot

    def _note_jumps(self, snapshot: Snapshot) -> None:
        """Note vehicles that have just jumped to another lane (`MAX_LATERAL_SPEED`); drop settled ones."""
        s, before = snapshot, self._newest
        self._jumped = {name: t for name, t in self._jumped.items() if s.time - t < SETTLING_TIME - 1e-9}
        if before is None or s.n == 0:
            return
        both = [(before.row[name], row) for row, name in enumerate(s.ids) if name in before.row]
        then, now = np.array(both, np.int64).reshape(-1, 2).T  # [c] rows of the vehicles in both frames
        x, y = s.x[now] - before.x[then], s.y[now] - before.y[then]
        aside = np.abs(np.cos(s.heading[now]) * y - np.sin(s.heading[now]) * x)  # [c] m
        turned = np.abs(np.remainder(s.heading[now] - before.heading[then] + np.pi, 2.0 * np.pi) - np.pi)
        for k in np.flatnonzero(aside > MAX_LATERAL_SPEED * (s.time - before.time)):
            a, b = int(before.lane[then[k]]), int(s.lane[now[k]])
            if a == b or min(a, b) < 0:
                continue
            whole = turned[k] < MAX_TURN and aside[k] > MIN_LATERAL_JUMP
            if whole or edge_of(self._road, a) == edge_of(self._road, b):
                self._jumped[s.ids[now[k]]] = s.time
                self._jumps += 1

    def _settled(self, snapshot: Snapshot) -> Snapshot:
        """The frame without the vehicles that jumped in the last `SETTLING_TIME` s."""
        s = snapshot
        kept = np.array([row for row, name in enumerate(s.ids) if name not in self._jumped], np.int64)
        return s if len(kept) == s.n else s.only(kept)

    def _check_positions(self, before: Snapshot, after: Snapshot) -> None:
        """Raises BadInput for positions in degrees, which hardly change at the speeds of cars."""
        elapsed = after.time - before.time
        for i, name in enumerate(after.ids):
            j = before.row.get(name)
            if j is not None:
                self._driven += after.speed[i] * elapsed
                self._moved += math.hypot(after.x[i] - before.x[j], after.y[i] - before.y[j])
        if self._driven >= MIN_CHECK_DISTANCE and self._moved < 0.01 * self._driven:
            problem = "positions do not fit the speeds: degrees (fcd-output.geo)? metres are needed"
            raise self._wrong(problem, "vehicle.x")

    def finish(self, has_road: bool, has_sizes: bool) -> Analysis:
        """The figures. Raises BadInput if the file allows none."""
        if self._first is not None:  # a file of one step
            self._set_clock(self._wanted or FRAME, self._first.time)
            self._count(self._snapshot(self._first))
        if not self._known or self._newest is None:
            whole = math.isinf(self._begin) and math.isinf(self._end)
            raise self._wrong("holds no vehicle" + ("" if whole else " in the requested time"))
        if self._unknown_lanes.total() > 0.5 * self._rows:
            problem = "no such lane in --net, which is not the net of this file"
            raise self._wrong(problem, "vehicle.lane", self._unknown_lanes.most_common(1)[0][0])
        figures = dict(itertools.chain.from_iterable(m.result().items() for m in self._metrics.values()))
        return Analysis(
            figures,
            self._began,
            self._newest.time,
            interval=round(self._stride * self._interval, 9),
            frames=self._frames,
            vehicles=len(self._known),
            watched=self._watched,
            notes=tuple(self._notes(has_road, has_sizes)),
            encounters=() if self._encounters is None else tuple(self._encounters.found()),
        )

    @property
    def _watched(self) -> int:
        """Number of AVs and mission vehicles."""
        return sum(kind == Kind.AV or mission for _, kind, mission, _ in self._known.values())

    def _notes(self, has_road: bool, has_sizes: bool) -> list[str]:
        apart = self._stride * self._interval  # s between frames
        everybody, size = self._roles.everybody, f"{DEFAULT.length:g} x {DEFAULT.width:g} m"
        types, lanes = (", ".join(sorted(names)[:5]) for names in (self._unknown_types, self._unknown_lanes))
        notes = {
            "every vehicle is watched (--av-type, --av-ids and --mission say otherwise)": everybody,
            "no vehicle is an AV or a mission vehicle: nothing to count": not (everybody or self._watched),
            f"every vehicle is taken as {size} (--types FILE says otherwise)": not has_sizes,
            f"not in --types, taken as {size}: {types}": has_sizes and bool(types),
            "without --net: conflicts include vehicles on and below a bridge, headways end with the lane": (
                not has_road
            ),
            f"{self._laneless} vehicle frames have no lane position: no headway there": bool(self._laneless),
            f"{self._unknown_lanes.total()} vehicle frames on lanes that --net lacks: {lanes}": bool(lanes),
            f"{self._jumps} lane changes that took no time (lanechange.duration 0): no time to collision and "
            f"no DRAC of that vehicle for {SETTLING_TIME:g} s": bool(self._jumps),
            f"steps of {self._interval:g} s are thinned to frames of {apart:g} s": self._stride > 1,
            f"frames every {apart:g} s: brief events are missed, jerk is damped": apart > FRAME + 1e-9,
        }
        return [note for note, holds in notes.items() if holds]

    def _wrong(self, problem: str, place: str | None = None, value: object = None) -> BadInput:
        return BadInput(problem, file=self._path, field=place, value=value)
