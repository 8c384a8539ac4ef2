"""Small hand-made traffic scenes for the policy's tests: straight lanes, cars at constant speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.road import Lane, RoadMap
from cosim.types import COMPACT, KINEMATIC_FEATURES, History, ObservationConfig

LANE_WIDTH = 3.2  # m
LENGTH = 1000.0  # m
LIMIT = 25.0  # m/s
FRAME = 0.2  # s


@dataclass(frozen=True)
class Car:
    """A car on lane `lane` (0 is the rightmost) of the straight road, its centre at x."""

    name: str
    x: float  # m
    lane: int
    speed: float  # m/s
    is_av: bool = False
    mission: bool = False
    target: float | None = None  # m/s, of an AV; its speed when None
    frames: int = 10  # how long it has been perceived
    accel: float = 0.0  # m/s2, so far
    offset: float = 0.0  # m beside its lane's centre line, left positive
    drift: float = 0.0  # m/s sideways
    changing: int = 0  # an AV's lane change under way

    @property
    def y(self) -> float:
        return self.lane * LANE_WIDTH + self.offset


def straight_road(lanes: int = 3, dead_end: int | None = None, at: float = 400.0) -> RoadMap:
    """Parallel lanes towards east from x = 0; lane `dead_end` ends at x = `at`, the others go on."""

    def lane(
        name: str, edge: str, i: int, x0: float, x1: float, successors: tuple[int, ...], left: int, right: int
    ) -> Lane:
        y = i * LANE_WIDTH
        shape = np.array([[x0, y], [x1, y]])
        return Lane(
            id=name,
            edge=edge,
            index=i,
            shape=shape,
            length=x1 - x0,
            width=LANE_WIDTH,
            speed_limit=LIMIT,
            successors=successors,
            left=left,
            right=right,
        )

    here = []
    cut = LENGTH if dead_end is None else at
    for i in range(lanes):
        goes_on = dead_end is not None and i != dead_end
        left = i + 1 if i + 1 < lanes else -1
        here.append(lane(f"a_{i}", "a", i, 0.0, cut, (lanes + i,) if goes_on else (), left, i - 1))
    if dead_end is not None:
        here += [lane(f"b_{i}", "b", i, cut, cut + LENGTH, (), -1, -1) for i in range(lanes)]
    return RoadMap(tuple(here))


def histories(
    road: RoadMap,
    cars: Sequence[Car],
    observation: ObservationConfig = COMPACT,
    route: tuple[str, ...] | None = None,
) -> dict[str, History]:
    """What every AV among `cars` knows; empty maps."""
    if route is None:
        route = ("a", "b") if any(lane.edge == "b" for lane in road.lanes) else ("a",)
    return {car.name: _history(road, car, cars, observation, route) for car in cars if car.is_av}


def _history(
    road: RoadMap, ego: Car, cars: Sequence[Car], observation: ObservationConfig, route: tuple[str, ...]
) -> History:
    n, r = observation.frames, observation.rows
    others = sorted((c for c in cars if c is not ego), key=lambda c: abs(c.x - ego.x) + abs(c.y - ego.y))
    shown = [ego, *others][:r]
    kinematics = np.zeros((n, r, len(KINEMATIC_FEATURES)), np.float32)
    valid = np.zeros((n, r), np.bool_)
    past = FRAME * np.arange(1 - n, 1)
    for k, car in enumerate(shown):
        speed = car.speed + car.accel * past
        x = car.x + car.speed * past + 0.5 * car.accel * past**2
        y = car.y + car.drift * past
        heading = np.arctan2(car.drift, max(car.speed, 1.0))
        rows = np.stack([x - ego.x, y - ego.y, speed, np.full(n, heading)], 1)
        kinematics[:, k, :4] = rows
        kinematics[:, k, 4:] = (5.0, 2.0, car.is_av, car.mission)
        valid[:, k] = np.arange(n) >= n - car.frames
    kinematics *= valid[..., None]
    pad = r - len(shown)
    lane = np.array([c.lane for c in shown] + [-1] * pad, np.int32)
    front = np.array([c.x + 2.5 for c in shown] + [0.0] * pad)
    maps = np.zeros((n, len(observation.channels), observation.height, observation.width), np.uint8)
    return History(
        velocity_map=maps,
        kinematics=kinematics,
        valid=valid,
        ids=tuple(c.name for c in shown) + ("",) * pad,
        lane=lane,
        lane_position=front,
        pose=np.array([ego.x, ego.y, 0.0]),
        target_speed=ego.speed if ego.target is None else ego.target,
        lane_changing=ego.changing,
        route=road.ahead(ego.lane, ego.x + 2.5, 5.0, route),
        time=0.0,
    )


def cars(speed: np.ndarray, heading: np.ndarray | None = None) -> np.ndarray:
    """[V,N,8] that are at (100, 50) now and came there with speeds and headings [V,N]."""
    state = np.zeros((*speed.shape, 8))
    state[:, :, 2] = speed
    state[:, :, 3] = 0.0 if heading is None else heading
    way = np.exp(1j * 0.5 * (state[:, 1:, 3] + state[:, :-1, 3])) * 0.5 * (speed[:, 1:] + speed[:, :-1])
    place = np.concatenate([np.zeros((len(speed), 1)), 0.2 * np.cumsum(way, 1)], 1)
    place += 100.0 + 50.0j - place[:, -1:]
    state[:, :, 0], state[:, :, 1] = place.real, place.imag
    state[:, :, 4:6] = (5.0, 2.0)
    return state


def braking_cars(seed: int, count: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Pasts and futures of cars whose braking or accelerating ends within the next second."""
    rng = np.random.default_rng(seed)
    time = 0.2 * np.arange(-9, 21)
    accel = rng.normal(0.0, 1.5, (count, 1))
    speed = np.maximum(15.0 + accel * np.minimum(time, rng.uniform(0.0, 1.0, (count, 1))), 0.0)
    state = cars(speed, rng.normal(0.0, 0.05, (count, 1)) * time)[:, :, :4]
    return state[:, :10], state[:, 10:]
