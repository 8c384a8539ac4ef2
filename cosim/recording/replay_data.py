"""A recorded episode for drawing: every vehicle's track, every decision and its outcome."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.recording.recorder import Belief, Choice, Recorder
from cosim.road import RoadMap
from cosim.scenario.behaviors import AS_IS
from cosim.types import (
    Actor,
    Bytes,
    Collision,
    Floats,
    Forecast,
    HumanError,
    Intervention,
    Ints,
    Kind,
    Offence,
    Simulator,
)


@dataclass(frozen=True)
class Track:
    """One vehicle's uninterrupted track, k frames from frame `first` on."""

    id: str
    kind: Kind
    mission: bool
    driver: str  # an HV's class of Table II, or "as-is", "" of others; for drawing only
    length: float  # m
    width: float  # m
    first: int
    x: Floats  # [k] m, centre
    y: Floats  # [k] m
    heading: Floats  # [k] rad
    speed: Floats  # [k] m/s
    accel: Floats  # [k] m/s2
    lane: Ints  # [k] index into the road's lanes, -1 off every lane
    actor: Actor = Actor.CAR


@dataclass(frozen=True)
class ReplayData:
    """One episode to be drawn; times in s of simulation time."""

    facts: Mapping[str, Any]  # the document of `cosim run --json`
    road: RoadMap
    begin: float  # s, start of the counted time
    interval: float  # s between frames
    times: Floats  # [T] s
    tracks: tuple[Track, ...]
    decided: Floats  # [D] s, times of the decisions
    choices: tuple[Mapping[str, Choice], ...]  # [D] AV -> choice
    forecasts: tuple[Forecast | None, ...]  # [D] the policy's forecast at that time
    collisions: tuple[Collision, ...]
    goal: frozenset[int] = frozenset()  # lanes on which the mission is fulfilled
    signals: Bytes = field(default_factory=lambda: np.zeros((0, 0), np.uint8))  # [T,s] as in `Snapshot`
    offences: tuple[Offence, ...] = ()
    interventions: tuple[Intervention, ...] = ()
    beliefs: tuple[Mapping[str, Belief] | None, ...] = ()  # [D] AV -> belief; None with ideal sensing
    errors: tuple[HumanError, ...] = ()  # first those that began in the warm-up


def replay_data(recorder: Recorder, simulator: Simulator, facts: Mapping[str, Any]) -> ReplayData:
    """The counted time of the recorded episode, driven on `simulator`."""
    frames = recorder.frames[recorder.first :]
    times = np.array([s.time for s in frames])
    # available from SUMO's simulator only
    drivers: Mapping[str, str] = getattr(simulator, "driver_classes", dict)()
    return ReplayData(
        facts=facts,
        road=simulator.road,
        begin=float(times[0]),
        interval=float(times[1] - times[0]) if len(times) > 1 else 0.0,
        times=times,
        tracks=tuple(tracks(recorder, drivers)),
        decided=np.array(recorder.decided),
        choices=tuple(recorder.choices),
        forecasts=tuple(recorder.forecasts),
        beliefs=tuple(recorder.beliefs),
        collisions=tuple(recorder.collisions),
        goal=simulator.goal_lanes,
        signals=np.stack([s.signals for s in frames]),
        offences=tuple(recorder.offences),
        interventions=tuple(recorder.interventions),
        errors=tuple(recorder.errors),
    )


def tracks(recorder: Recorder, drivers: Mapping[str, str]) -> list[Track]:
    """One track per uninterrupted presence of a vehicle; `drivers`: each HV's class by id."""
    body, motion = ("kind", "mission", "length", "width", "actor"), ("x", "y", "heading", "speed", "accel")
    ids, frame, vehicle, table = recorder.vehicles(*body, *motion, "lane")
    counted = np.flatnonzero(frame >= recorder.first)
    gaps = np.flatnonzero((np.diff(vehicle[counted]) != 0) | (np.diff(frame[counted]) > 1)) + 1
    found = []
    for rows in np.split(counted, gaps) if len(counted) else ():
        name, first, last = ids[vehicle[rows[0]]], int(frame[rows[0]]), rows[-1]
        kind = Kind(int(table["kind"][last]))
        driver = drivers.get(name, AS_IS) if kind == Kind.HV else ""
        size = float(table["length"][last]), float(table["width"][last])
        # single precision: 1 mm in 10 km
        poses = {column: table[column][rows].astype(np.float32).astype(np.float64) for column in motion}
        lane = table["lane"][rows].astype(np.int64)
        mission, actor = bool(table["mission"][last]), Actor(int(table["actor"][last]))
        begin = first - recorder.first
        found.append(Track(name, kind, mission, driver, *size, begin, lane=lane, actor=actor, **poses))
    return found
