"""An in-memory Simulator without SUMO, for tests: a straight road, IDM drivers, commanded AVs."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from cosim.control import TIME_CONSTANT, tracked_speed
from cosim.road import Lane, RoadMap
from cosim.types import Collision, Command, Events, Kind, Receipt, Snapshot, Timing

LANE_WIDTH = 3.2  # m, SUMO's default
LATERAL_SPEED = LANE_WIDTH / 2.0  # m/s: a lane change takes 2 s


@dataclass(slots=True)
class FakeVehicle:
    """One vehicle of the fake simulator; `x`: m along the road, of the front bumper."""

    id: str
    x: float
    lane: int  # 0 rightmost
    speed: float  # m/s
    is_av: bool = False
    mission: bool = False
    desired: float = 25.0  # m/s, desired speed without a command
    target: float | None = None  # m/s, commanded speed
    asks: float | None = None  # m/s2, commanded acceleration, in place of `target`
    goal_lane: int = -1  # target of the active lane change; -1: none
    offset: float = 0.0  # m, lateral, from the centre of `lane`
    accel: float = 0.0
    time_loss: float = 0.0  # s, relative to the desired speed
    length: float = 5.0
    width: float = 2.0


class FakeSimulator:
    """`cosim.types.Simulator` on a straight road of `lanes` lanes and `length` m.

    `vehicles` start each episode as given; `seed` only shifts their positions by at most 1 m.
    """

    courtesy = 1.0

    def __init__(
        self,
        vehicles: Sequence[FakeVehicle],
        *,
        lanes: int = 2,
        length: float = 2000.0,
        speed_limit: float = 25.0,
        timing: Timing = Timing(),
        goal: Sequence[int] = (),
    ) -> None:
        self.road = straight_road(lanes, length, speed_limit)
        self.goal_lanes = frozenset(goal)
        self._template = tuple(vehicles)
        self._timing = timing
        self._length = length

    def reset(self, seed: int) -> tuple[Snapshot, ...]:
        """One frame: all vehicles at the start."""
        rng = np.random.default_rng(seed)
        self._time = 0.0
        self._hit: set[frozenset[str]] = set()
        self._arrived: list[str] = []
        self._vehicles = {v.id: replace(v, x=v.x + rng.uniform(-1, 1)) for v in self._template}
        return (self._snapshot(),)

    def advance(self, commands: Sequence[Command]) -> tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]:
        """Apply the commands for one decision."""
        named = {c.vehicle for c in commands}
        for v in self._vehicles.values():
            if v.id not in named:
                v.target = None  # handed back to IDM, as in SUMO
        receipts = tuple(self._take(c) for c in commands)
        return receipts, self._drive(round(self._timing.decision / self._timing.frame))

    def ahead(self, frames: int, commands: Sequence[Command] = ()) -> tuple[Snapshot, ...]:
        """A counterfactual rollout; without driver errors."""
        other = copy.copy(self)
        other._vehicles, other._hit = copy.deepcopy(self._vehicles), set(self._hit)
        other._arrived = [*self._arrived]
        for command in commands:
            other._take(command)
        return other._drive(frames)

    def _drive(self, frames: int) -> tuple[Snapshot, ...]:
        found = []
        for _ in range(frames):
            for _ in range(round(self._timing.frame / self._timing.step)):
                self._step()
            found.append(self._snapshot())
        return tuple(found)

    def route(self, vehicle: str) -> tuple[str, ...]:
        """The only edge."""
        return ("road",)

    def commanded(self, vehicle: str) -> tuple[float | None, int]:
        """Target speed in m/s and the active lane change."""
        v = self._vehicles[vehicle]
        return v.target, 0 if v.goal_lane < 0 else int(np.sign(v.goal_lane - v.lane))

    @property
    def tilted(self) -> tuple[float, dict[str, list[float]]]:
        """No driver errors."""
        return 0.0, {}

    def counts(self) -> dict[str, int]:
        """All vehicles are inserted at the start."""
        return {"inserted": len(self._template), "waiting": 0}

    def close(self) -> None:
        """Nothing to free."""

    def _take(self, command: Command) -> Receipt:
        v = self._vehicles.get(command.vehicle)
        if v is None:
            return Receipt(command.vehicle, False, "not on the road")
        v.target, v.asks = command.target_speed, command.accel
        if command.lane_offset == 0:
            return Receipt(v.id, True)
        if v.goal_lane >= 0:
            return Receipt(v.id, False, "a lane change is under way")
        if not 0 <= v.lane + command.lane_offset < len(self.road.lanes):
            return Receipt(v.id, False, "no lane on that side")
        v.goal_lane = v.lane + command.lane_offset
        return Receipt(v.id, True)

    def _step(self) -> None:
        step = self._timing.step
        old = {v.id: v.speed for v in self._vehicles.values()}
        for v in self._vehicles.values():
            free = max(v.speed + self._idm(v, old) * step, 0.0)
            target = v.target if v.asks is None else v.speed + v.asks * TIME_CONSTANT
            wanted = free if target is None else tracked_speed(v.speed, target, step)
            v.accel = (wanted - v.speed) / step
            v.speed = wanted
        for v in list(self._vehicles.values()):
            v.x += v.speed * step
            v.time_loss += step * (1.0 - v.speed / v.desired)
            if v.goal_lane >= 0:
                side = 1 if v.goal_lane > v.lane else -1
                v.offset += side * LATERAL_SPEED * step
                if abs(v.offset) >= LANE_WIDTH / 2 and v.offset * side > 0:
                    v.lane, v.offset = v.goal_lane, v.offset - side * LANE_WIDTH
                    v.goal_lane = -1
            elif abs(v.offset) > 1e-9:
                v.offset -= float(np.sign(v.offset)) * min(abs(v.offset), LATERAL_SPEED * step)
            if v.x > self._length:
                del self._vehicles[v.id]
                self._arrived.append(v.id)
        self._time = round(self._time + step, 9)

    def _idm(self, v: FakeVehicle, speeds: dict[str, float]) -> float:
        """IDM with Table II's moderate parameters, m/s2."""
        free = 1.0 - (v.speed / v.desired) ** 4
        ahead = [o for o in self._vehicles.values() if o.lane == v.lane and o.x > v.x]
        if not ahead:
            return 3.0 * free
        leader = min(ahead, key=lambda o: o.x)
        gap = max(leader.x - leader.length - v.x, 0.1)
        dv = v.speed - speeds[leader.id]
        wanted = 2.0 + max(0.0, v.speed + v.speed * dv / (2 * np.sqrt(3.0 * 7.0)))
        return float(max(3.0 * (free - (wanted / gap) ** 2), -9.0))

    def _snapshot(self) -> Snapshot:
        vs = [self._vehicles[name] for name in sorted(self._vehicles)]
        centre_y = np.array([(v.lane + 0.5) * LANE_WIDTH + v.offset for v in vs])
        arrived, self._arrived = tuple(self._arrived), []
        return Snapshot(
            time=self._time,
            ids=tuple(v.id for v in vs),
            kind=np.array([Kind.AV if v.is_av else Kind.HV for v in vs], np.int8),
            mission=np.array([v.mission for v in vs], np.bool_),
            x=np.array([v.x - v.length / 2 for v in vs]),
            y=centre_y,
            heading=np.zeros(len(vs)),
            speed=np.array([v.speed for v in vs]),
            accel=np.array([v.accel for v in vs]),
            length=np.array([v.length for v in vs]),
            width=np.array([v.width for v in vs]),
            lane=np.array([v.lane for v in vs], np.int32),
            lane_position=np.array([v.x for v in vs]),
            events=Events(collisions=tuple(self._collisions(vs, centre_y)), arrived=arrived),
            time_loss=np.array([v.time_loss for v in vs]),
            waiting={},
        )

    def _collisions(self, vs: list[FakeVehicle], y: np.ndarray) -> list[Collision]:
        found = []
        for (ya, a), (yb, b) in combinations(zip(y, vs, strict=True), 2):
            pair = frozenset((a.id, b.id))
            beside = abs(ya - yb) < (a.width + b.width) / 2
            if pair in self._hit or not beside or a.x - a.length >= b.x or b.x - b.length >= a.x:
                continue
            self._hit.add(pair)
            hits, hit = (a, b) if a.x < b.x else (b, a)
            found.append(
                Collision(
                    self._time, hits.id, hit.id, hits.is_av, hit.is_av, "overlap", "box",
                    f"road_{hits.lane}", hits.x, float(ya), hits.mission or hit.mission, hits.is_av,
                )
            )  # fmt: skip
        return found


def straight_road(lanes: int, length: float, speed_limit: float) -> RoadMap:
    """A straight road eastwards: edge `road`, lane 0 at the right (y = 1.6 m), in m and m/s."""
    return RoadMap(
        tuple(
            Lane(
                id=f"road_{k}",
                edge="road",
                index=k,
                shape=np.array([[0.0, (k + 0.5) * LANE_WIDTH], [length, (k + 0.5) * LANE_WIDTH]]),
                length=length,
                width=LANE_WIDTH,
                speed_limit=speed_limit,
                left=k + 1 if k + 1 < lanes else -1,
                right=k - 1,
            )
            for k in range(lanes)
        )
    )
