"""The one recorder of an episode: a hook that keeps what was driven, decided and predicted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from cosim.episode import Episode, Hook, Step
from cosim.types import (
    Collision,
    Decision,
    Forecast,
    HumanError,
    Intervention,
    Ints,
    Offence,
    Policy,
    Snapshot,
)

DRAWN = 400_000  # vehicle frames of a drawing: about 2 MB of page


class Knowledge(NamedTuple):
    """What an AV knew beside the traffic at one decision: enough to build its `History` anew."""

    route: tuple[str, ...] = ()  # edges still ahead, the present one first
    target_speed: float | None = None  # m/s; None while SUMO drives it
    lane_changing: int = 0  # +1 left, -1 right


@dataclass(frozen=True, slots=True)
class Choice:
    """What one AV decided, and what became of it."""

    decision: Decision
    target: float  # m/s, the speed commanded
    blocked: str | None  # why the command was not executed


class Recorder(Hook):
    """Keeps the last episode; `recording.file.write` stores it, `recording.replay_data` reads it.

    `limit`: vehicle frames kept at most; beyond, every second frame goes, which is enough to draw from.
    `policy`: whose forecasts are kept.
    """

    def __init__(self, policy: Policy | None = None, limit: float = np.inf) -> None:
        self._policy, self._limit = policy, limit

    def on_start(self, episode: Episode) -> None:
        """The warm-up's last frames come first."""
        self.begin(episode.frames)
        self._know(episode)

    def on_step(self, episode: Episode, step: Step) -> None:
        """Its frames, its decisions, and what the policy predicted for them."""
        self.decided.append(step.before.time)
        self.forecasts.append(getattr(self._policy, "last_forecast", None) if step.decisions else None)
        outcomes = zip(step.commands, step.receipts, strict=True)
        self.choices.append(
            {c.vehicle: Choice(step.decisions[c.vehicle], c.target_speed, r.blocked) for c, r in outcomes}
        )
        for frame in step.frames:
            self.add(frame)
        self.offences[:] = episode.offences
        self._know(episode)

    def begin(self, frames: Sequence[Snapshot]) -> None:
        """Discard the last episode; the clock of the next one is 0 at the last of these frames."""
        self.frames: list[Snapshot] = list(frames)
        self.first = len(frames) - 1
        self.known: dict[int, dict[str, Knowledge]] = {}  # decision frame -> AV -> what it knew
        self.decided: list[float] = []  # s, when decisions were taken
        self.choices: list[dict[str, Choice]] = []
        self.forecasts: list[Forecast | None] = []
        self.collisions: list[Collision] = [*frames[-1].events.collisions]
        self.offences: list[Offence] = []
        self.interventions: list[Intervention] = []
        before = [error for frame in frames for error in frame.events.errors]  # in the warm-up
        self.errors: list[HumanError] = [e for e in before if e.until > frames[-1].time]
        self._stride, self._driven, self._kept = 1, 0, sum(s.n for s in frames)

    def add(self, frame: Snapshot) -> None:
        """One more frame; every second one goes once there are too many, and the forecasts of its time."""
        self.collisions += frame.events.collisions
        self.interventions += frame.events.interventions
        self.errors += frame.events.errors
        self._driven += 1
        if self._driven % self._stride:
            return
        self.frames.append(frame)
        self._kept += frame.n
        if self._kept > self._limit and len(self.frames) - self.first > 2:
            self.frames = self.frames[self.first :: 2]
            self.first, self._stride = 0, 2 * self._stride
            self._kept = sum(s.n for s in self.frames)
            kept = {s.time for s in self.frames}
            decided = zip(self.decided, self.forecasts, strict=True)
            self.forecasts = [forecast if time in kept else None for time, forecast in decided]

    def vehicles(self, *columns: str) -> tuple[list[str], Ints, Ints, dict[str, Any]]:
        """Every vehicle in every frame: L rows, a vehicle's frames together.

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
