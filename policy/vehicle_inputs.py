"""What the HPN's kinematic branch is told of every vehicle: its past, two forecasts, whom it meets.

Every vehicle is seen in its own frame (its centre at the newest frame, x ahead, y left), so what is learned
holds wherever a road lies and whatever world it belongs to. Two forecasts stand side by side: the Gaussian
process's (P, eq. 7-9), which knows no road, and the same speeds carried along the vehicle's lane.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosim.actions import LANE_CHANGE_TIME, tracked_speeds
from cosim.road import RoadMap
from cosim.types import Bools, Floats, Floats32, Ints, MetaAction
from policy.forecast import KinematicForecast
from policy.motion import Rollout, fronts, pack, project_many, roll_out
from policy.safety.maneuver import ways_of
from policy.scene import Scene
from policy.traffic import Traffic, TrafficConfig

MARKS = (4, 9, 14, 19)  # frames ahead (from 0) at which forecasts are shown: 1, 2, 3, 4 s
NEIGHBOURS = 8  # the nearest: who matters to a driver is near
SIGHT = 80.0  # m, further away nobody is a neighbour
LEADERS = 2  # ahead on the own path
OPEN = 150.0  # m: gaps and lane ends further away are all alike
OWN_INPUTS = 124
NEIGHBOUR_INPUTS = 17


class VehicleInputs(NamedTuple):
    """E entries: the V vehicles of the scene as others see them, then its B AVs as each knows itself.

    An AV knows its own route and command, and nobody else's.
    """

    vehicle: Ints  # [E] place among the scene's vehicles
    own: Floats32  # [E,OWN_INPUTS] scaled to about [-1, 1]
    near: Floats32  # [E,K,NEIGHBOUR_INPUTS]; zeros where there is nobody
    lane: Floats  # [E,M,4] x m, y m, speed m/s, heading rad in the world, along the lane
    gp: Floats  # [E,M,4] the same by the Gaussian process
    known: Bools  # [E] perceived in the newest frame


def vehicle_inputs(
    scene: Scene, forecast: KinematicForecast, traffic: Traffic, road: RoadMap, config: TrafficConfig
) -> VehicleInputs:
    """Gather the inputs; `forecast` and `traffic` of the scene's vehicles, at least MARKS[-1] + 1 frames."""
    m = forecast.x.shape[1]
    who = np.concatenate([np.arange(len(scene.vehicles)), scene.ego])  # [E]
    gp = np.stack([forecast.x, forecast.y, forecast.speed, forecast.heading], -1)[who]  # [E,M,4]
    lane = _states(traffic.rollout, m)
    lane = np.concatenate([lane, _states(_own_ways(scene, road, config, m), m)])
    now, past = scene.state[who, -1], scene.state[who]  # [E,8], [E,N,8]
    before = np.nan_to_num(past)
    seen = scene.valid[who] & np.isfinite(past).all(2)  # [E,N]
    known = forecast.valid[who]
    lane = np.where((known & (np.abs(lane).sum((1, 2)) > 0))[:, None, None], lane, gp)
    # a whole turn more or less means nothing
    turns = np.round((lane[..., 3] - gp[..., 3]) / (2 * np.pi))
    lane[..., 3] -= 2 * np.pi * turns
    own = np.concatenate(
        [
            _fixed(scene, traffic, who, now),
            _past(before, seen, now),
            _ahead(gp, now),
            _ahead(lane, now),
            np.stack([forecast.along_std, forecast.across_std], -1)[who][:, MARKS, :].reshape(len(who), -1)
            / 10.0,
            _leaders(scene, traffic, who, now, before, seen),
            _command(scene, len(who)),
        ],
        1,
    )
    near = _near(scene, who, now, before, seen, lane, known)
    own = np.clip(np.nan_to_num(own), -5.0, 5.0) * known[:, None]
    return VehicleInputs(who, own.astype(np.float32), near.astype(np.float32), lane, gp, known)


def to_own(points: Floats, now: Floats) -> tuple[Floats, Floats]:
    """World points [E,...,2] in each vehicle's own frame, now [E,>=4] -> ahead, left [E,...] m."""
    shape = (-1,) + (1,) * (points.ndim - 2)
    dx, dy = points[..., 0] - now[:, 0].reshape(shape), points[..., 1] - now[:, 1].reshape(shape)
    c, s = np.cos(now[:, 3]).reshape(shape), np.sin(now[:, 3]).reshape(shape)
    return c * dx + s * dy, c * dy - s * dx


def _states(rollout: Rollout, frames: int) -> Floats:
    """[k,frames,4] x y speed heading of the frames ahead."""
    s = slice(1, frames + 1)
    return np.stack([rollout.x[:, s], rollout.y[:, s], rollout.speed[:, s], rollout.heading[:, s]], -1)


def _own_ways(scene: Scene, road: RoadMap, config: TrafficConfig, frames: int) -> Rollout:
    """Every AV along its own route at its present command, as it knows them itself: [B,frames+1]."""
    idle = tuple(MetaAction).index(MetaAction.IDLE)
    now = scene.state[scene.ego, -1]  # [B,8]
    paths, speeds = [], np.empty((len(now), frames + 1))
    for b, history in enumerate(scene.histories):
        paths.append(ways_of(history, road, int(scene.lane[scene.ego[b]]))[idle].path)
        speeds[b] = tracked_speeds(float(now[b, 2]), np.array([history.target_speed]), frames, config.dt)[0]
    packed = pack(paths)
    arc, offset = project_many(*packed, *fronts(now), np.array([h.route.arc for h in scene.histories]))
    wide = np.abs(offset) > config.settle_rate  # a lane change under way
    return roll_out(
        packed,
        arc,
        offset,
        np.zeros(len(now)),
        now[:, 3],
        np.where(wide, 3.2 / LANE_CHANGE_TIME, config.settle_rate),
        now[:, 4],
        speeds,
        np.array([p.length - 0.5 if p.dead_end else np.inf for p in paths]),
        config.stop_brake,
        config.dt,
    )


def _fixed(scene: Scene, traffic: Traffic, who: Ints, now: Floats) -> Floats:
    """[E,12] what does not depend on time: size, kind, place on the road."""
    v = len(scene.vehicles)
    road = np.zeros((v, 5))
    for k, path in enumerate(traffic.stream):
        if path is None:
            continue
        arc = traffic.rollout.arc[k, 0]  # m, front
        end = path.length - arc if path.dead_end else OPEN
        road[k] = (
            1.0,
            1.0 - np.clip(end, 0.0, OPEN) / OPEN,
            1.0 - np.clip(path.conflict - arc, 0.0, OPEN) / OPEN,
            float(path.leaves),
            traffic.drifting[k],
        )
    limit = np.zeros(v)
    return (
        np.stack(
            [
                now[:, 2] / 30.0,
                now[:, 4] / 10.0,
                now[:, 5] / 3.0,
                now[:, 6],
                now[:, 7],
                np.arange(len(who)) >= v,  # as it knows itself
                np.clip(traffic.rollout.rear[who, 0] / 3.2, -2.0, 2.0),
                *road[who].T,
            ],
            1,
        )
        + 0.0 * limit[who][:, None]
    )


def _past(before: Floats, seen: Bools, now: Floats) -> Floats:
    """[E,4(N-1)+N] the past in the own frame: how it differs from now."""
    ahead, left = to_own(before[..., :2], now)
    n = before.shape[1]
    elapsed = 0.2 * np.arange(1 - n, 1)
    parts = np.stack(
        [
            (ahead - now[:, 2:3] * elapsed) / 5.0,
            left / 3.0,
            (before[..., 2] - now[:, 2:3]) / 5.0,
            (before[..., 3] - now[:, 3:4]) / 0.3,
        ],
        -1,
    )[:, :-1]
    parts = np.where(seen[:, :-1, None], parts, 0.0)
    return np.concatenate([parts.reshape(len(now), -1), seen], 1)


def _ahead(states: Floats, now: Floats) -> Floats:
    """[E,16] a forecast at the MARKS, against driving on straight at the present speed."""
    at = states[:, MARKS, :]
    ahead, left = to_own(at[..., :2], now)
    elapsed = 0.2 * (1 + np.array(MARKS))
    return np.stack(
        [
            (ahead - now[:, 2:3] * elapsed) / 15.0,
            left / 8.0,
            (at[..., 2] - now[:, 2:3]) / 8.0,
            (at[..., 3] - now[:, 3:4]) / 0.8,
        ],
        -1,
    ).reshape(len(now), -1)


def _accel(before: Floats, seen: Bools) -> Floats:
    """[E] m/s2 over the last 0.4 s; 0 where unknown."""
    if before.shape[1] < 3:
        return np.zeros(len(before))
    return np.where(seen[:, -3] & seen[:, -1], (before[:, -1, 2] - before[:, -3, 2]) / 0.4, 0.0)


def _leaders(scene: Scene, traffic: Traffic, who: Ints, now: Floats, before: Floats, seen: Bools) -> Floats:
    """[E,LEADERS*5] the next ones on the vehicle's own path: there at all, gap, speed, closing, acceleration."""
    v = len(scene.vehicles)
    accel = _accel(before[:v], seen[:v])
    on = [(j, int(k)) for j, k in enumerate(scene.lane) if k >= 0 and traffic.known[j]]
    by_lane: dict[int, list[int]] = {}
    for j, k in on:
        by_lane.setdefault(k, []).append(j)
    out = np.zeros((v, LEADERS, 5))
    for i, path in enumerate(traffic.stream):
        if path is None:
            continue
        front = traffic.rollout.arc[i, 0]
        ahead = []
        for place, k in enumerate(path.lanes):
            if path.lane_start[place] > front + OPEN:
                break
            for j in by_lane.get(k, ()):
                gap = (
                    path.lane_start[place]
                    + scene.lane_position[j] * path.scale
                    - scene.state[j, -1, 4]
                    - front
                )
                if j != i and -3.0 < gap < OPEN:
                    ahead.append((gap, j))
        ahead.sort()
        for place, (gap, j) in enumerate(ahead[:LEADERS]):
            speed = scene.state[j, -1, 2]
            closing = scene.state[i, -1, 2] - speed
            out[i, place] = (1.0, np.exp(-max(gap, 0.0) / 20.0), speed / 30.0, closing / 8.0, accel[j] / 4.0)
    return out.reshape(v, -1)[who]


def _command(scene: Scene, entries: int) -> Floats:
    """[E,4] an AV's own command: target speed against its own and the limit, lane change; 0 for all others."""
    out = np.zeros((entries, 4))
    for b, history in enumerate(scene.histories):
        out[entries - len(scene.histories) + b] = (
            (history.target_speed - history.ego_speed) / 5.0,
            history.target_speed / 30.0,
            history.lane_changing,
            (history.route.speed_limit - history.ego_speed) / 10.0,
        )
    return out


def _near(
    scene: Scene, who: Ints, now: Floats, before: Floats, seen: Bools, lane: Floats, known: Bools
) -> Floats:
    """[E,K,NEIGHBOUR_INPUTS] the nearest others, now and along their lanes."""
    v, e = len(scene.vehicles), len(who)
    others = now[:v]
    point = np.broadcast_to(others[None, :, :2], (e, v, 2))
    ahead, left = to_own(point, now)  # [E,V]
    distance = np.hypot(ahead, left)
    hidden = ~known[None, :v] | (np.arange(v)[None] == who[:, None])
    if not scene.shared:  # each AV keeps its own copy of everybody
        owner = _owners(scene)
        hidden |= owner[None, :] != owner[who][:, None]
    distance = np.where(hidden | (distance > SIGHT), np.inf, distance)
    k = min(NEIGHBOURS, v)
    nearest = np.argpartition(distance, k - 1, 1)[:, :k] if k < v else np.tile(np.arange(v), (e, 1))
    there = np.isfinite(np.take_along_axis(distance, nearest, 1))  # [E,k]
    rows = np.arange(e)[:, None]
    turn = others[nearest, 3] - now[:, None, 3]
    accel = _accel(before[:v], seen[:v])
    parts = [
        np.ones_like(turn),
        ahead[rows, nearest] / 40.0,
        left[rows, nearest] / 8.0,
        np.cos(turn),
        np.sin(turn),
        others[nearest, 2] / 30.0,
        (others[nearest, 2] - now[:, None, 2]) / 8.0,
        accel[nearest] / 4.0,
        others[nearest, 4] / 10.0,
        others[nearest, 6],
        scene.lane[nearest] == scene.lane[who][:, None],
    ]
    for mark in MARKS[:3]:
        then = lane[:v, mark, :2][nearest]  # [E,k,2]
        mine = np.concatenate([lane[:, mark, :2], now[:, 2:3], lane[:, mark, 3:4]], 1)
        x, y = to_own(then, mine)
        parts += [np.clip(x / 40.0, -3.0, 3.0), np.clip(y / 8.0, -3.0, 3.0)]
    found = np.stack(parts, -1) * (there & known[:, None])[..., None]
    out = np.zeros((e, NEIGHBOURS, NEIGHBOUR_INPUTS))
    out[:, :k] = np.clip(np.nan_to_num(found), -5.0, 5.0)
    return out


def _owners(scene: Scene) -> Ints:
    """[V] whose knowledge each vehicle is, without V2V."""
    owner = np.full(len(scene.vehicles), -1, np.int64)
    for b, row in enumerate(scene.row):
        owner[row[row >= 0]] = b
    return owner
