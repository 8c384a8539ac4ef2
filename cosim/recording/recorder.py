"""The recorder of an episode: a hook that stores motion, decisions and predictions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from cosim.episode import Episode, Hook, Step
from cosim.types import (
    Collision,
    Decision,
    Floats,
    Forecast,
    HumanError,
    Intervention,
    Ints,
    Offence,
    Policy,
    Snapshot,
    Unseen,
)

MAX_DRAWN_FRAMES = 400_000  # vehicle frames of a replay page: about 2 MB


class Knowledge(NamedTuple):
    """An AV's knowledge besides the traffic at one decision, enough to rebuild its `History`."""

    route: tuple[str, ...] = ()  # edges still ahead, the present one first
    target_speed: float | None = None  # m/s; None while SUMO drives it, in `lawful` the limit
    lane_changing: int = 0  # +1 left, -1 right


@dataclass(frozen=True, slots=True)
class Choice:
    """One AV's decision and its outcome."""

    decision: Decision
    target: float  # m/s, the speed commanded
    blocked: str | None  # reason why the command was not executed


class Belief(NamedTuple):
    """One AV's belief about k vehicles and persons at a decision, relative to the truth of that moment."""

    ids: tuple[str, ...]
    x: Floats  # [k] m, believed minus true position
    y: Floats  # [k] m
    age: Floats  # [k] s since the newest measurement
    source: Ints  # [k] `Source` of that
    unseen: Mapping[str, Unseen]  # objects in range that its own sensors did not detect


def beliefs(frame: Snapshot) -> dict[str, Belief] | None:
    """AV -> its belief about the traffic; None with ideal sensing."""
    if frame.percepts is None:
        return None
    found = {}
    for av, percept in frame.percepts.items():
        world = percept.world
        mine = np.array([k for k, name in enumerate(world.ids) if name in frame.row and name != av], np.int64)
        ids = tuple([world.ids[k] for k in mine])
        true = np.array([frame.row[name] for name in ids], np.int64)
        off = world.x[mine] - frame.x[true], world.y[mine] - frame.y[true]
        known = percept.age[mine], percept.source[mine].astype(np.int64)
        found[av] = Belief(ids, *off, *known, percept.unseen)
    return found


class Recorder(Hook):
    """Holds the last episode; `recording.file.write` stores it, `recording.replay_data` reads it.

    `limit`: largest number of vehicle frames; beyond it every second frame is dropped, enough for drawing.
    `policy`: source of the forecasts.
    """

    def __init__(self, policy: Policy | None = None, limit: float = np.inf) -> None:
        self._policy, self._limit = policy, limit

    def on_start(self, episode: Episode) -> None:
        """Begin with the warm-up's last frames."""
        self.begin(episode.frames)
        self._know(episode)

    def on_step(self, episode: Episode, step: Step) -> None:
        """Add the step's frames, decisions and the policy's forecast."""
        self.decided.append(step.before.time)
        self.forecasts.append(getattr(self._policy, "last_forecast", None) if step.decisions else None)
        self.beliefs.append(beliefs(step.before))
        outcomes = zip(step.commands, step.receipts, strict=True)
        self.choices.append(
            {c.vehicle: Choice(step.carried_out[c.vehicle], c.target_speed, r.blocked) for c, r in outcomes}
        )
        for frame in step.frames:
            self.add(frame)
        self.offences[:] = episode.offences
        self._know(episode)

    def begin(self, frames: Sequence[Snapshot]) -> None:
        """Discard the last episode; the next episode's clock is 0 at the last of these frames."""
        self.frames: list[Snapshot] = [_truth(frame) for frame in frames]
        self.first = len(frames) - 1
        self.known: dict[int, dict[str, Knowledge]] = {}  # decision frame -> AV -> knowledge
        self.decided: list[float] = []  # s, time of each decision
        self.choices: list[dict[str, Choice]] = []
        self.forecasts: list[Forecast | None] = []
        self.beliefs: list[dict[str, Belief] | None] = []  # of every decision
        self.collisions: list[Collision] = [*frames[-1].events.collisions]
        self.offences: list[Offence] = []
        self.interventions: list[Intervention] = []
        before = [error for frame in frames for error in frame.events.errors]  # in the warm-up
        self.errors: list[HumanError] = [e for e in before if e.until > frames[-1].time]
        self._stride, self._driven, self._kept = 1, 0, sum(s.n for s in frames)

    def add(self, frame: Snapshot) -> None:
        """Add one frame; above the limit every second frame and its forecast are dropped."""
        self.collisions += frame.events.collisions
        self.interventions += frame.events.interventions
        self.errors += frame.events.errors
        self._driven += 1
        if self._driven % self._stride:
            return
        self.frames.append(_truth(frame))
        self._kept += frame.n
        if self._kept > self._limit and len(self.frames) - self.first > 2:
            self.frames = self.frames[self.first :: 2]
            self.first, self._stride = 0, 2 * self._stride
            self._kept = sum(s.n for s in self.frames)
            kept = {s.time for s in self.frames}
            decided = zip(self.decided, self.forecasts, self.beliefs, strict=True)
            drawn = [(f, b) if time in kept else (None, None) for time, f, b in decided]
            self.forecasts, self.beliefs = [f for f, _ in drawn], [b for _, b in drawn]

    def vehicles(self, *columns: str) -> tuple[list[str], Ints, Ints, dict[str, Any]]:
        """Every vehicle in every frame: L rows, grouped by vehicle.

        Returns: ids, sorted [V]; the frame and the vehicle (index into the ids) of each row [L]; the
        `columns` of `Snapshot` [L].
        """
        frame = np.repeat(np.arange(len(self.frames)), [s.n for s in self.frames])
        names, vehicle = np.unique([name for s in self.frames for name in s.ids], return_inverse=True)
        order = np.lexsort((frame, vehicle))
        joined = {name: np.concatenate([getattr(s, name) for s in self.frames])[order] for name in columns}
        return names.tolist(), frame[order], vehicle[order], joined

    def _know(self, episode: Episode) -> None:
        s = episode.simulator
        self.known[len(self.frames) - 1] = {
            av: Knowledge(s.route(av), *s.commanded(av)) for av in episode.histories
        }


def _truth(frame: Snapshot) -> Snapshot:
    """The snapshot without percepts, to save memory."""
    return frame if frame.percepts is None else replace(frame, percepts=None)
