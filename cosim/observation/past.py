"""The last N frames of every vehicle and of every AV's maps: written once, read as views."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cosim.types import Bytes, Floats, Ints, ObservationConfig, Snapshot

STRETCH = 3  # tapes are this many histories long, so that a history is always one contiguous view


class KinematicPast:
    """[N, S, 4] x m, y m, speed m/s, unwrapped heading rad; a slot per vehicle, nan where absent."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._tape = np.full((STRETCH * frames, 64, 4), np.nan)
        self._end = frames
        self._slot: dict[str, int] = {}
        self._free: list[int] = list(range(64))
        self.slots: Ints = np.zeros(0, np.int64)  # [n] slot of each vehicle of the newest snapshot
        self._ids: tuple[str, ...] = ()

    @property
    def view(self) -> Floats:
        """[N,S,4] oldest first."""
        return self._tape[self._end - self._frames : self._end]

    def add(self, snapshot: Snapshot) -> None:
        """Append one frame."""
        if self._end == len(self._tape):
            self._tape[: self._frames] = self._tape[-self._frames :]
            self._end = self._frames
        if snapshot.ids is not self._ids:
            self._assign(snapshot)
        before = self._tape[self._end - 1, self.slots, 3]
        turn = snapshot.heading - np.where(np.isnan(before), snapshot.heading, before)
        heading = snapshot.heading - 2 * np.pi * np.round(turn / (2 * np.pi))
        row = self._tape[self._end]
        row[:] = np.nan
        row[self.slots, 0] = snapshot.x
        row[self.slots, 1] = snapshot.y
        row[self.slots, 2] = snapshot.speed
        row[self.slots, 3] = heading
        self._end += 1

    def _assign(self, snapshot: Snapshot) -> None:
        for name in self._slot.keys() - snapshot.row.keys():
            self._free.append(self._slot.pop(name))
        for name in snapshot.ids:
            if name not in self._slot:
                if not self._free:
                    have = self._tape.shape[1]
                    more = np.full((len(self._tape), have, 4), np.nan)
                    self._tape = np.concatenate([self._tape, more], axis=1)
                    self._free.extend(range(have, 2 * have))
                slot = self._slot[name] = self._free.pop()
                self._tape[self._end - self._frames : self._end, slot] = np.nan
        self.slots = np.array([self._slot[name] for name in snapshot.ids], np.int64)
        self._ids = snapshot.ids


class MapPast:
    """[N,C,H,W] uint8 per AV, in one block so that all AVs of a frame are drawn by one call."""

    def __init__(self, config: ObservationConfig) -> None:
        self._frames = config.frames
        self._shape = (len(config.channels), config.height, config.width)
        self._tape: Bytes = np.zeros((STRETCH * config.frames, 0, *self._shape), np.uint8)
        self._end = config.frames
        self._slot: dict[str, int] = {}
        self._free: list[int] = []

    def clear(self) -> None:
        """A new episode: nobody is known. The tape stays, so that its memory is touched only once."""
        self._free.extend(self._slot.values())
        self._slot.clear()

    def next_frame(self, avs: list[str]) -> tuple[Bytes, npt.NDArray[np.int64]]:
        """The block [S,C,H,W] to draw the new frame into, and the slot of each AV (a new AV's past is 0)."""
        for name in self._slot.keys() - set(avs):
            self._free.append(self._slot.pop(name))
        if self._end == len(self._tape):
            used = list(self._slot.values())
            self._tape[: self._frames, used] = self._tape[-self._frames :, used]
            self._end = self._frames
        for name in avs:
            if name not in self._slot:
                if not self._free:
                    have = self._tape.shape[1]
                    more = np.zeros((len(self._tape), max(have, 8), *self._shape), np.uint8)
                    self._tape = np.concatenate([self._tape, more], axis=1)
                    self._free.extend(range(self._tape.shape[1] - 1, have - 1, -1))
                slot = self._slot[name] = self._free.pop()
                self._tape[self._end - self._frames : self._end, slot] = 0
        self._end += 1
        return self._tape[self._end - 1], np.array([self._slot[name] for name in avs], np.int64)

    def view(self, av: str) -> Bytes:
        """[N,C,H,W] oldest first; stays as it is for N further frames at least."""
        return self._tape[self._end - self._frames : self._end, self._slot[av]]
