"""A Simulator that remembers what it showed: the episode loop records without knowing of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from cosim.types import Command, Receipt, Simulator, Snapshot


class Knowledge(NamedTuple):
    """What an AV knew beside the traffic at one decision: enough to build its `History` anew."""

    route: tuple[str, ...] = ()  # edges still ahead, the present one first
    target_speed: float | None = None  # m/s; None while SUMO drives it
    lane_changing: int = 0  # +1 left, -1 right


@dataclass
class Tape:
    """One episode: its frames, oldest first, and what each AV knew at the decision frames."""

    seed: int
    first: int  # index of the frame at which the clock of the episode is 0; before it the warm-up's last
    frames: list[Snapshot] = field(default_factory=list)
    known: dict[int, dict[str, Knowledge]] = field(default_factory=dict)  # frame -> AV -> knowledge


class RecordingSimulator:
    """`cosim.types.Simulator` around another one; `tape` holds the episode driven last."""

    def __init__(self, inner: Simulator) -> None:
        self._inner = inner
        self.road = inner.road
        self.goal_lanes = inner.goal_lanes
        self.tape = Tape(seed=0, first=0)

    def reset(self, seed: int) -> tuple[Snapshot, ...]:
        """Start the episode and a new tape."""
        frames = self._inner.reset(seed)
        self.tape = Tape(seed, len(frames) - 1, list(frames))
        return frames

    def advance(self, commands: Sequence[Command]) -> tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]:
        """Hold the commands for one decision."""
        receipts, frames = self._inner.advance(commands)
        self.tape.frames += frames
        return receipts, frames

    def route(self, vehicle: str) -> tuple[str, ...]:
        """The edges still ahead; asked for at a decision, so kept with its frame."""
        route = self._inner.route(vehicle)
        self._note(vehicle, route=route)
        return route

    def commanded(self, vehicle: str) -> tuple[float | None, int]:
        """Target speed and lane change under way; kept like the route."""
        target, change = self._inner.commanded(vehicle)
        self._note(vehicle, target_speed=target, lane_changing=change)
        return target, change

    def counts(self) -> dict[str, int]:
        """Vehicles inserted and waiting."""
        return self._inner.counts()

    def close(self) -> None:
        """End the simulation."""
        self._inner.close()

    def _note(self, vehicle: str, **known: Any) -> None:
        here = self.tape.known.setdefault(len(self.tape.frames) - 1, {})
        here[vehicle] = here.get(vehicle, Knowledge())._replace(**known)
