"""Mission: success and time of the mission vehicle."""

from collections.abc import Iterable

from cosim.metrics.context import MetricContext
from cosim.types import Metric, Snapshot

STANDSTILL_SPEED = 0.1  # m/s, SUMO's own threshold of a halting vehicle


class MissionSuccess:
    """Success is reaching a goal lane without an earlier collision (figures.md, Mission and distance).

    All mission vehicles must succeed; the time is that of the last. NA without a mission or goal, or before a
    mission vehicle appears; with mission `auto`, until one has been on a lane that ends or gives way, and its
    arrival is a success too.
    """

    def reset(self, first: Snapshot, context: MetricContext) -> None:
        self._goal = context.goal
        self._applies = context.mission_kind != "none" and bool(context.goal)
        self._auto, self._lanes = context.mission_kind == "auto", context.road.lanes
        self._begin = first.time
        self._reached: dict[str, float | None] = {}  # id -> s from the episode's start
        self._crashed: set[str] = set()
        self._standing: set[str] = set()
        self.add(first)

    def add(self, snapshot: Snapshot) -> None:
        if not self._applies:
            return
        for collision in snapshot.events.collisions:  # they precede this frame's positions
            self._crashed.update(collision.vehicles)
        self._standing.difference_update(snapshot.events.arrived)
        if self._auto:  # its route may end before any goal lane
            self._reach(snapshot, self._reached.keys() & snapshot.events.arrived)
        for row in snapshot.mission.nonzero()[0].tolist():
            name, lane = snapshot.ids[row], int(snapshot.lane[row])
            if self._auto and name not in self._reached and not self._struggles(lane):
                continue
            if self._reached.setdefault(name, None) is not None:
                continue
            if snapshot.speed[row] <= STANDSTILL_SPEED:
                self._standing.add(name)
            else:
                self._standing.discard(name)
            if lane in self._goal:
                self._reach(snapshot, (name,))

    def _reach(self, snapshot: Snapshot, names: Iterable[str]) -> None:
        for name in names:
            if name not in self._crashed and self._reached[name] is None:
                self._reached[name] = snapshot.time - self._begin

    def _struggles(self, lane: int) -> bool:
        """Whether the lane ends or gives way (False for -1, off every lane)."""
        return lane >= 0 and lane not in self._goal and not self._lanes[lane].internal

    def result(self) -> dict[str, Metric]:
        success = failed = when = None
        if self._reached:
            times = [time for time in self._reached.values() if time is not None]
            success = len(times) == len(self._reached)
            when = max(times) if success else None
            # standing without success, typically at the end of its lane
            failed = any(self._reached[name] is None for name in self._standing)
        return {
            "mission_success": Metric(success, "bool", "higher"),
            "mission_failed_at_end": Metric(failed, "bool", "lower"),
            "mission_time_s": Metric(when, "s", "lower"),
        }
