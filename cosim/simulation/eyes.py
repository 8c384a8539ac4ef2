"""An AV's view of other road users: the true state, or with a sensing level its percept.

A percept belongs to the last frame. Its errors in that frame are kept in the steps up to the next frame: a
vehicle believed 3 m too far back stays 3 m too far back.
"""

import math
from collections.abc import Iterable
from itertools import compress
from typing import Any

from cosim.road import RoadMap
from cosim.simulation.backend import sumo
from cosim.types import Kind, Percept, Snapshot

PERSON = "person:"  # prefix of a person's id in a snapshot


class Eyes:
    """The views of all AVs; `update` takes every frame."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self._truth: Snapshot | None = None
        self._vehicles: list[str] = []  # on the road; empty with ideal sensing
        self._views: dict[str, View] = {}

    def update(self, snapshot: Snapshot) -> None:
        """Take a new frame, with percepts unless sensing is ideal."""
        self._truth = snapshot
        if not self.ideal:
            vehicles = (snapshot.kind != int(Kind.PERSON)).tolist()
            self._vehicles = list(compress(snapshot.ids, vehicles))
        self._views.clear()

    @property
    def ideal(self) -> bool:
        """Whether every AV knows the true state."""
        return self._truth is None or self._truth.percepts is None

    def view(self, av: str) -> Any:
        """SUMO's calls for vehicles (`sumo.vehicle`), which answer with what `av` believes."""
        return self._percept_view(av) or sumo.vehicle

    def known(self, av: str, names: Iterable[str]) -> Iterable[str]:
        """The vehicles among `names` that `av` knows of."""
        view = self._percept_view(av)
        return names if view is None else [name for name in names if name in view.rows]

    def person_position(self, av: str, person: str) -> tuple[float, float] | None:
        """The position (m) of a person as `av` believes it; None: the person is unknown."""
        view = self._percept_view(av)
        x, y = sumo.person.getPosition(person)
        if view is None:
            return x, y
        known = view.rows.get(PERSON + person)
        return None if known is None else (x + view.offsets[known][0], y + view.offsets[known][1])

    def is_av(self, av: str, other: str, avs: Iterable[str]) -> bool:
        """Whether `av` takes another vehicle for an AV; `avs`: the true AVs."""
        view = self._percept_view(av)
        if view is None or other not in avs:
            return other in avs
        row = view.rows.get(other)
        return row is not None and view.percept.world.kind[row] == Kind.AV

    def hears(self, av: str, other: str) -> bool:
        """Whether a V2V message of `other` reaches `av` in time."""
        view = self._percept_view(av)
        return view is None or av == other or other in view.percept.hears

    def unknown(self, av: str) -> list[str]:
        """The vehicles on the road that `av` does not know of."""
        view = self._percept_view(av)
        if view is None:
            return []
        return [name for name in self._vehicles if name not in view.rows and name != av]

    def _percept_view(self, av: str) -> "View | None":
        view, truth = self._views.get(av), self._truth
        if view is None and truth is not None and truth.percepts is not None and av in truth.percepts:
            view = self._views[av] = View(self._road, av, truth, truth.percepts[av])
        return view


class View:
    """`sumo.vehicle` as one AV may use it: the believed states of known vehicles; other calls go to SUMO."""

    def __init__(self, road: RoadMap, av: str, truth: Snapshot, percept: Percept) -> None:
        self.percept, self._road, self._av = percept, road, av
        world = percept.world
        # vehicle or person -> its row in the percept, without those that have left the road since
        self.rows = {name: k for k, name in enumerate(world.ids) if name in truth.row}
        here = [truth.row.get(name, 0) for name in world.ids]
        columns = (
            *(world.x - truth.x[here], world.y - truth.y[here], world.speed - truth.speed[here]),
            *(world.heading - truth.heading[here], world.lane_position - truth.lane_position[here]),
        )
        self.offsets: list[tuple[float, ...]] = list(zip(*(c.tolist() for c in columns), strict=True))
        self._same_lane = (world.lane == truth.lane[here]).tolist()
        self._lane, self._position = world.lane.tolist(), world.lane_position.tolist()
        self._accel = world.accel.tolist()

    def __getattr__(self, name: str) -> Any:
        return getattr(sumo.vehicle, name)

    def position_lag(self, name: str, heading: float) -> float:
        """m by which the believed position lags behind the true one along `heading` (rad)."""
        dx, dy, *_ = self.offsets[self.rows[name]]
        return -(dx * math.cos(heading) + dy * math.sin(heading))

    def getSpeed(self, name: str) -> float:
        """m/s"""
        speed = float(sumo.vehicle.getSpeed(name))
        row = self.rows.get(name)
        return speed if row is None else max(speed + self.offsets[row][2], 0.0)

    def getAcceleration(self, name: str) -> float:
        """m/s2"""
        row = self.rows.get(name)
        if row is None or name == self._av:
            return float(sumo.vehicle.getAcceleration(name))
        return float(self._accel[row])

    def getPosition(self, name: str) -> tuple[float, float]:
        """m, the front bumper"""
        x, y = sumo.vehicle.getPosition(name)
        row = self.rows.get(name)
        return (x, y) if row is None else (x + self.offsets[row][0], y + self.offsets[row][1])

    def getAngle(self, name: str) -> float:
        """degrees clockwise from north"""
        angle = float(sumo.vehicle.getAngle(name))
        row = self.rows.get(name)
        return angle if row is None else angle - math.degrees(self.offsets[row][3])

    def getLaneID(self, name: str) -> str:
        """The lane on which the vehicle is believed to be."""
        row = self.rows.get(name)
        if row is None or self._same_lane[row]:
            return str(sumo.vehicle.getLaneID(name))
        return self._road.lanes[self._lane[row]].id if self._lane[row] >= 0 else ""

    def getLanePosition(self, name: str) -> float:
        """m along the believed lane, the front bumper"""
        row = self.rows.get(name)
        if row is None:
            return float(sumo.vehicle.getLanePosition(name))
        if not self._same_lane[row]:
            return float(self._position[row])
        return max(float(sumo.vehicle.getLanePosition(name)) + self.offsets[row][4], 0.0)
