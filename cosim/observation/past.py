"""The last N frames of every vehicle and of every AV's maps: written once, read as views."""

from typing import Any

import numpy as np
import numpy.typing as npt

from cosim.types import Bytes, Floats, Ints, ObservationConfig, Snapshot

STRETCH = 3  # buffer length in histories, so that a history is always one contiguous view


class FrameBuffer:
    """[K,S,...] frames of numbered slots, one per present vehicle; K = `STRETCH` N.

    Args:
        frames: N, length of a history.
        slots: initial number of vehicles; the buffer grows as needed.
        absent: the value of a slot in the frames before its vehicle appeared.
        cell: shape of one vehicle's data in one frame.
        dtype: its type.
    """

    def __init__(self, frames: int, slots: int, absent: float, cell: tuple[int, ...], dtype: Any) -> None:
        self._frames, self._absent = frames, absent
        self._buffer = np.empty((STRETCH * frames, slots, *cell), dtype)
        self._end = frames
        self._slot: dict[str, int] = {}
        self._free = list(range(slots))
        self.clear()

    def clear(self) -> None:
        """Start an episode without known vehicles. The buffer is reused to avoid new page faults."""
        self._assign(())

    def next_frame(self, vehicles: tuple[str, ...]) -> tuple[npt.NDArray[Any], Ints]:
        """The new frame [S,...] to write into, and the slot [n] of each present vehicle."""
        if self._end == len(self._buffer):
            used = list(self._slot.values())
            self._buffer[: self._frames, used] = self._buffer[-self._frames :, used]
            self._end = self._frames
        if vehicles != self._vehicles:
            self._assign(vehicles)
        self._end += 1
        return self._buffer[self._end - 1], self.slots

    @property
    def window(self) -> npt.NDArray[Any]:
        """[N,S,...] the newest N frames, oldest first."""
        return self._buffer[self._end - self._frames : self._end]

    def _assign(self, vehicles: tuple[str, ...]) -> None:
        """Assign slots to new vehicles, and free the slots of vehicles that left."""
        for name in self._slot.keys() - set(vehicles):
            self._free.append(self._slot.pop(name))
        for name in vehicles:
            if name not in self._slot:
                if not self._free:
                    self._grow()
                slot = self._slot[name] = self._free.pop()
                self.window[:, slot] = self._absent
        self.slots = np.array([self._slot[name] for name in vehicles], np.int64)
        self._vehicles = vehicles

    def _grow(self) -> None:
        """Double the slots; the lowest new slot is used first."""
        count, have, *cell = self._buffer.shape
        more = np.empty((count, max(have, 8), *cell), self._buffer.dtype)
        self._buffer = np.concatenate([self._buffer, more], axis=1)
        self._free.extend(range(self._buffer.shape[1] - 1, have - 1, -1))


class KinematicPast(FrameBuffer):
    """[N,S,4] x m, y m, speed m/s, unwrapped heading rad; nan where a vehicle was absent."""

    def __init__(self, frames: int) -> None:
        super().__init__(frames, 64, np.nan, (4,), np.float64)

    def add(self, snapshot: Snapshot) -> None:
        """Append one frame."""
        new, slots = self.next_frame(snapshot.ids)
        before: Floats = self._buffer[self._end - 2, slots, 3]
        turn = snapshot.heading - np.where(np.isnan(before), snapshot.heading, before)
        heading = snapshot.heading - 2 * np.pi * np.round(turn / (2 * np.pi))
        new[slots] = np.array((snapshot.x, snapshot.y, snapshot.speed, heading)).T


class MapPast(FrameBuffer):
    """[N,C,H,W] uint8 per AV, in one block so that all AVs of a frame are drawn by one call."""

    def __init__(self, config: ObservationConfig) -> None:
        cell = (len(config.channels), config.height, config.width)
        super().__init__(config.frames, 0, 0.0, cell, np.uint8)

    def view(self, av: str) -> Bytes:
        """[N,C,H,W] oldest first; valid for at least N further frames."""
        return self.window[:, self._slot[av]]
