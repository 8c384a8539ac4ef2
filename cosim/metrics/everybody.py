"""All vehicles due to depart, so that the policy does not affect the choice (figures.md, Everybody)."""

import numpy as np

from cosim.metrics.slots import Slots, grown
from cosim.types import Bools, Floats, Ints, Kind, Snapshot


class Everybody:
    """The vehicles on the road in the counted time, a slot each, and vehicles waiting for insertion.

    A vehicle that cannot continue loses the time up to the horizon: a wreck that was taken off the road, and
    every vehicle if a crash ends the episode (`ends`) before the counted time of `duration` s.
    """

    def __init__(self, duration: float, ends: bool) -> None:
        self._duration, self._ends = duration, ends
        self._slots = Slots()
        self._crashed = False
        self.wrecks: dict[str, float] = {}  # wreck taken off the road -> s, time of its last frame
        self._av: Bools = np.zeros(64, np.bool_)
        self._entry: Floats = np.zeros(64)  # [slots] s
        self._rows: Ints = np.zeros(0, np.int64)
        self._newest: Snapshot | None = None

    def of(self, snapshot: Snapshot) -> Ints:
        """[n] slots of the vehicles of this newest frame; repeated calls count the frame once."""
        if snapshot is self._newest:
            return self._rows
        vehicles, known = snapshot.vehicles, self._rows
        self._rows = self._slots.rows(vehicles.ids)
        if self._rows is not known:  # a vehicle came or left
            self._av = grown(self._av, len(self), False)
            self._entry = grown(self._entry, len(self), 0.0)
            self._av[self._rows] = vehicles.kind == int(Kind.AV)
        if self._newest is None:
            self._begin = snapshot.time
        else:
            self._happen(snapshot, self._newest.time)
        self._newest = snapshot
        return self._rows

    def __len__(self) -> int:
        return len(self._slots)

    def number(self, vehicle: str) -> int:
        """The slot of a vehicle, -1 for one that was in no frame."""
        found: int = self._slots.of.get(vehicle, -1)
        return found

    @property
    def av(self) -> Bools:
        """[slots] whether the vehicle is an AV."""
        return self._av[: len(self)]

    @property
    def entry(self) -> Floats:
        """[slots] s of counted time waiting for insertion."""
        return self._entry[: len(self)]

    @property
    def rest(self) -> Floats:
        """[slots] s from the last frame to the horizon for vehicles that cannot continue; else 0."""
        found = np.zeros(len(self))
        if self._crashed:
            found[self._rows] = self._horizon - self._now
        for wreck, when in self.wrecks.items():
            found[self.number(wreck)] = self._horizon - when
        return found

    @property
    def waiting(self) -> tuple[Floats, Bools]:
        """[w] s of counted time up to the horizon of vehicles that are not inserted, and whether each will be
        an AV; a single nan if unknown."""
        if self._newest is None or self._newest.waiting is None:
            return np.full(1, np.nan), np.zeros(1, np.bool_)
        due = self._newest.waiting.values()
        since = np.array([max(one.since, self._begin) for one in due], np.float64)
        return self._horizon - since, np.array([one.is_av for one in due], np.bool_)

    # ---- inside ----

    @property
    def _now(self) -> float:
        return self._newest.time if self._newest is not None else 0.0

    @property
    def _horizon(self) -> float:
        """End of the counted time of all vehicles, s."""
        return self._begin + self._duration if self._crashed else self._now

    def _happen(self, snapshot: Snapshot, before: float) -> None:
        """Process the events since the frame at `before` (s)."""
        events = snapshot.events
        for vehicle, delay in zip(events.departed, events.depart_delays, strict=False):
            if (slot := self.number(vehicle)) >= 0:
                self._entry[slot] = min(delay, snapshot.time - self._begin)
        gone = (name for name in events.wrecks_removed if self.number(name) >= 0)
        self.wrecks.update(dict.fromkeys(gone, before))
        self._crashed |= self._ends and any(c.crash for c in events.collisions)
