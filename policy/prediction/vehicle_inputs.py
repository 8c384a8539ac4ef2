"""The inputs of the HPN's kinematic branch, by vehicle: its past, two forecasts, its neighbours.

Inputs are in the vehicle's own frame (its centre at the newest frame, x ahead, y left), so training transfers
to any road and scenario. There are two forecasts: the Gaussian process's (P, eq. 7-9), without the road, and
the same speeds carried along the vehicle's lane. No input is private to the driver: no class, route or
desired speed.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.geometry.compiled import compiled
from cosim.types import HEADING, IS_AV, IS_MISSION, LENGTH, SPEED, WIDTH, Bools, Floats, Floats32, Ints, X, Y
from policy.inputs.scene import Scene
from policy.prediction.forecast import KinematicForecast
from policy.prediction.traffic import Traffic

FRAME_S = 0.2  # s
FORECAST_MARKS = np.array([4, 9, 14, 19])  # frames ahead (from 0) of the forecast inputs: 1, 2, 3, 4 s
NEIGHBOURS = 8  # number of nearest vehicles
NEIGHBOUR_RADIUS = 80.0  # m
LEADERS = 2  # number of vehicles ahead on the own path
MAX_GAP = 150.0  # m, cap of gaps and of distances to lane ends
FIXED_INPUTS, MARK_INPUTS, LEADER_INPUTS = 11, 4, 5  # inputs per vehicle, per mark of a forecast, per leader
NEIGHBOUR_INPUTS = 17
MAX_INPUT = 5.0  # clip value of scaled inputs


class VehicleInputs(NamedTuple):
    """Inputs of the V vehicles of a scene."""

    own: Floats32  # [V,own_inputs(N)] scaled to about [-1, 1]
    near: Floats32  # [V,NEIGHBOURS,NEIGHBOUR_INPUTS] zeros without a neighbour
    lane: Floats  # [V,M,4] x m, y m, speed m/s, heading rad in the world: along the lane
    gp: Floats  # [V,M,4] the Gaussian process's forecast
    known: Bools  # [V] perceived in the newest frame; the others' inputs are zeros


def own_inputs(frames: int) -> int:
    """Number of a vehicle's own inputs with `frames` past frames."""
    marks = len(FORECAST_MARKS)
    return FIXED_INPUTS + 5 * frames - 4 + 2 * MARK_INPUTS * marks + LEADER_INPUTS * LEADERS


def vehicle_inputs(scene: Scene, forecast: KinematicForecast, traffic: Traffic) -> VehicleInputs:
    """Gather the inputs. `forecast`, `traffic`: of the scene's vehicles, at least 4 s (FORECAST_MARKS)."""
    m = forecast.x.shape[1]
    gp = np.stack([forecast.x, forecast.y, forecast.speed, forecast.heading], -1)  # [V,M,4]
    r = traffic.rollout
    lane = np.stack([a[:, 1 : m + 1] for a in (r.x, r.y, r.speed, r.heading)], -1)
    known = forecast.valid & traffic.known
    lane = np.where(known[:, None, None], lane, gp)
    lane[..., 3] -= 2 * np.pi * np.round((lane[..., 3] - gp[..., 3]) / (2 * np.pi))  # same multiple of 2 pi
    now = np.nan_to_num(scene.state[:, -1])  # [V,8]
    past = np.nan_to_num(scene.state)
    seen = scene.valid & np.isfinite(scene.state).all(2)  # [V,N]
    accel = _accel(past, seen)
    own = np.concatenate(
        [
            _fixed(traffic, now),
            _past(past, seen, now),
            _ahead(gp, now),
            _ahead(lane, now),
            _leaders(scene, traffic, now, accel, known),
        ],
        1,
    )
    own = np.clip(np.nan_to_num(own), -MAX_INPUT, MAX_INPUT) * known[:, None]
    near = _near(scene, now, accel, lane, known)
    return VehicleInputs(own.astype(np.float32), near, lane, gp, known)


def _to_own(x: Floats, y: Floats, now: Floats) -> tuple[Floats, Floats]:
    """World points [V,k] in each vehicle's own frame, now [V,>=4] -> ahead, left [V,k] m."""
    c, s = np.cos(now[:, HEADING, None]), np.sin(now[:, HEADING, None])
    dx, dy = x - now[:, X, None], y - now[:, Y, None]
    return c * dx + s * dy, c * dy - s * dx


def _fixed(traffic: Traffic, now: Floats) -> Floats:
    """[V,FIXED_INPUTS] speed, size, kind, and position on the road."""
    vehicle = now[:, [SPEED, LENGTH, WIDTH, IS_AV, IS_MISSION]] / (30.0, 10.0, 3.0, 1.0, 1.0)
    beside = np.clip(traffic.rollout.rear[:, 0] / 3.2, -2.0, 2.0)  # in lane widths beside its path
    place = np.zeros((len(now), 4))
    at = [
        (k, p.length if p.dead_end else np.inf, p.conflict, p.leaves)
        for k, p in enumerate(traffic.stream)
        if p is not None
    ]
    if at:
        rows, end, conflict, leaves = (np.array(v) for v in zip(*at, strict=True))
        front = traffic.rollout.arc[rows, 0]  # m
        near = [1.0 - np.clip(distance - front, 0.0, MAX_GAP) / MAX_GAP for distance in (end, conflict)]
        place[rows] = np.stack([np.ones(len(rows)), *near, leaves], 1)
    return np.concatenate([vehicle, beside[:, None], traffic.drifting[:, None], place], 1)


def _past(past: Floats, seen: Bools, now: Floats) -> Floats:
    """[V,5N-4] the past in the own frame, relative to straight motion at the present speed; its validity."""
    v, n = seen.shape
    ahead, left = _to_own(past[:, :-1, X], past[:, :-1, Y], now)
    elapsed = FRAME_S * np.arange(1 - n, 0)
    parts = (
        (ahead - now[:, SPEED, None] * elapsed) / 5.0,
        left / 3.0,
        (past[:, :-1, SPEED] - now[:, SPEED, None]) / 5.0,
        (past[:, :-1, HEADING] - now[:, HEADING, None]) / 0.3,
    )
    known = np.stack(parts, -1) * seen[:, :-1, None]
    return np.concatenate([known.reshape(v, -1), seen], 1)


def _ahead(states: Floats, now: Floats) -> Floats:
    """[V,MARK_INPUTS*marks] a forecast at FORECAST_MARKS, relative to straight motion at present speed."""
    at = states[:, FORECAST_MARKS]
    ahead, left = _to_own(at[..., X], at[..., Y], now)
    parts = (
        (ahead - now[:, SPEED, None] * FRAME_S * (1 + FORECAST_MARKS)) / 15.0,
        left / 8.0,
        (at[..., SPEED] - now[:, SPEED, None]) / 8.0,
        (at[..., HEADING] - now[:, HEADING, None]) / 0.8,
    )
    return np.stack(parts, -1).reshape(len(now), -1)


def _accel(past: Floats, seen: Bools) -> Floats:
    """[V] m/s2 over the last 0.4 s; 0 where unknown."""
    if past.shape[1] < 3:
        return np.zeros(len(past))
    return np.where(seen[:, -3] & seen[:, -1], (past[:, -1, SPEED] - past[:, -3, SPEED]) / (2 * FRAME_S), 0.0)


def _leaders(scene: Scene, traffic: Traffic, now: Floats, accel: Floats, known: Bools) -> Floats:
    """[V,LEADERS*LEADER_INPUTS] vehicles ahead: existence, gap, speed, closing speed, acceleration."""
    start = np.zeros(len(now) + 1, np.int64)
    np.cumsum([0 if p is None else len(p.lanes) for p in traffic.stream], out=start[1:])
    paths = [p for p in traffic.stream if p is not None]
    lanes = np.array([k for p in paths for k in p.lanes], np.int64)
    begins = np.concatenate([p.lane_start for p in paths]) if paths else np.zeros(0)
    scale = np.array([1.0 if p is None else p.scale for p in traffic.stream])
    place = np.where(known, scene.lane, -2).astype(np.int64)
    leader, gap = _next_on_path(
        start,
        lanes,
        begins,
        scale,
        place,
        _owner(scene),
        scene.lane_position.astype(np.float64),
        now[:, LENGTH],
        traffic.rollout.arc[:, 0],
    )
    there = leader >= 0
    j = np.maximum(leader, 0)
    parts = (
        np.ones(leader.shape),
        np.exp(-np.maximum(gap, 0.0) / 20.0),
        now[j, SPEED] / 30.0,
        (now[:, None, SPEED] - now[j, SPEED]) / 8.0,
        accel[j] / 4.0,
    )
    return np.asarray((np.stack(parts, -1) * there[..., None]).reshape(len(now), -1))


@compiled
def _next_on_path(
    start: Ints,  # [V+1] start of each vehicle's path in lanes, begins
    lanes: Ints,  # [p]
    begins: Floats,  # [p] m, arc at the start of each lane
    scale: Floats,  # [V] arc length per lane position
    place: Ints,  # [V] lane of each vehicle, negative off every lane
    owner: Ints,  # [V] owner of the observation
    position: Floats,  # [V] m, front bumper along its lane
    length: Floats,  # [V] m
    front: Floats,  # [V] m, arc of the front bumper along the own path
) -> tuple[Ints, Floats]:
    """The nearest two vehicles ahead on every path [V,2] (-1: none) and the gaps to them [V,2] m."""
    count = place.shape[0]
    leader, gap = np.full((count, 2), -1), np.full((count, 2), np.inf)
    for i in range(count):
        for k in range(start[i], start[i + 1]):
            if begins[k] > front[i] + 150.0:
                break
            for j in range(count):
                if place[j] != lanes[k] or j == i or owner[j] != owner[i]:
                    continue
                ahead = begins[k] + position[j] * scale[i] - length[j] - front[i]
                if ahead < -3.0 or ahead > 150.0 or ahead >= gap[i, 1]:
                    continue
                if ahead < gap[i, 0]:
                    gap[i, 1], leader[i, 1] = gap[i, 0], leader[i, 0]
                    gap[i, 0], leader[i, 0] = ahead, j
                else:
                    gap[i, 1], leader[i, 1] = ahead, j
    return leader, gap


def _near(scene: Scene, now: Floats, accel: Floats, lane: Floats, known: Bools) -> Floats32:
    """[V,NEIGHBOURS,NEIGHBOUR_INPUTS] the nearest vehicles, now and along their lanes."""
    v = len(now)
    out = np.zeros((v, NEIGHBOURS, NEIGHBOUR_INPUTS), np.float32)
    k = min(NEIGHBOURS, v)
    square = (now[:, None, X] - now[None, :, X]) ** 2 + (now[:, None, Y] - now[None, :, Y]) ** 2
    owner = _owner(scene)
    hidden = ~known[None] | (owner[:, None] != owner[None]) | (square > NEIGHBOUR_RADIUS**2)
    hidden[np.diag_indices(v)] = True
    square[hidden] = np.inf
    j = np.argpartition(square, k - 1, 1)[:, :k]  # [V,k]
    j = np.take_along_axis(j, np.argsort(np.take_along_axis(square, j, 1), 1, kind="stable"), 1)
    there = np.isfinite(np.take_along_axis(square, j, 1)) & known[:, None]
    ahead, left = _to_own(now[j, X], now[j, Y], now)
    turn = now[j, HEADING] - now[:, HEADING, None]
    parts = [np.ones(j.shape), ahead / 40.0, left / 8.0, np.cos(turn), np.sin(turn)]
    parts += [now[j, SPEED] / 30.0, (now[j, SPEED] - now[:, SPEED, None]) / 8.0, accel[j] / 4.0]
    parts += [now[j, LENGTH] / 10.0, now[j, IS_AV], scene.lane[j] == scene.lane[:, None]]
    for mark in FORECAST_MARKS[:3]:
        mine = lane[:, mark]  # position at the mark
        ahead, left = _to_own(mine[j, X], mine[j, Y], mine)
        parts += [ahead / 40.0, left / 8.0]
    inputs = np.nan_to_num(np.stack(parts, -1).astype(np.float32))
    out[:, :k] = np.clip(inputs, -MAX_INPUT, MAX_INPUT) * there[..., None]
    return out


def _owner(scene: Scene) -> npt.NDArray[np.int64]:
    """[V] owner of each vehicle's observation: all AVs with V2V, else one AV."""
    owner = np.zeros(len(scene.vehicles), np.int64)
    if not scene.shared:
        for b, row in enumerate(scene.row):
            owner[row[row >= 0]] = b
    return owner
