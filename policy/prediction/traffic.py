"""Predicted traffic: every vehicle's predicted speed carried along its real lane."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.road import LanePath, RoadMap
from cosim.types import HEADING, LENGTH, SPEED, WIDTH, Bools, Floats, X, Y
from policy.inputs.scene import Scene
from policy.prediction.forecast import KinematicForecast
from policy.prediction.motion import Rollout, fronts, pack, project_many, roll
from policy.prediction.protocol import Predictor


@dataclass(frozen=True, slots=True)
class TrafficConfig:
    """The model of other vehicles' motion along their lanes."""

    dt: float = 0.2  # s
    drift_rate: float = 0.4  # m/s, lateral speed from which a vehicle counts as changing lanes
    drift_offset: float = 0.2  # m from the centre line, below which no vehicle counts as changing lanes
    drift_limits: tuple[float, float] = (0.8, 2.4)  # m/s, lateral speed of a lane change; SUMO's is 1.6 m/s
    settle_rate: float = 0.3  # m/s, lateral speed at which a remaining offset closes
    stop_brake: float = 4.0  # m/s2, deceleration towards the end of a lane
    speed_factor: float = 1.2  # cap of predicted speeds: this times the limit (or the present speed)


class Traffic(NamedTuple):
    """V vehicles of a scene, rolled out."""

    rollout: Rollout  # [V,T+1]
    length: Floats  # [V] m
    width: Floats  # [V] m
    stream: tuple[LanePath | None, ...]  # [V] the path each follows (its target lane's, when changing)
    drifting: Bools  # [V] changing lanes now
    known: Bools  # [V] perceived in the newest frame


def foresee(
    scene: Scene, predictor: Predictor, road: RoadMap, config: TrafficConfig, frames: int | None = None
) -> tuple[KinematicForecast, Traffic]:
    """The predictor's forecast of every vehicle of a scene, and its speeds carried along the lanes.

    Args:
        scene: the AVs' joined knowledge.
        predictor: forecasts `predictor.horizon` frames.
        road: the road map.
        config: the model of motion along the lanes.
        frames: length of the rollout (default: the predictor's horizon).
    """
    forecast = predictor.predict(scene.state, scene.valid)
    return forecast, predict_traffic(scene, forecast, road, config, frames or predictor.horizon)


def predict_traffic(
    scene: Scene, forecast: KinematicForecast, road: RoadMap, config: TrafficConfig, frames: int
) -> Traffic:
    """Carry the forecast speeds along the lanes for `frames` frames (beyond the forecast: its last speed).

    A vehicle keeps its lane and follows the straightest path (its route is unknown). A vehicle with lateral
    motion is predicted into the adjacent lane; a merging car therefore appears there only after it starts to
    move. At the end of a lane vehicles stop. Vehicles off every lane follow the forecast.

    Args:
        scene: the AVs' joined knowledge.
        forecast: [V,M] of its vehicles, in world coordinates.
        road: the road map.
        config: the model of motion along the lanes.
        frames: of `config.dt` s.

    Returns:
        the rollout [V,frames+1] of every vehicle; frame 0 is now.
    """
    c = config
    count = len(scene.vehicles)
    now = scene.state[:, -1]  # [V,8]
    known = forecast.valid & (scene.lane >= -1)
    speed = np.empty((count, frames + 1))
    m = min(forecast.speed.shape[1], frames)
    speed[:, 0] = now[:, SPEED]
    speed[:, 1 : m + 1] = forecast.speed[:, :m]
    speed[:, m + 1 :] = forecast.speed[:, m - 1 : m]
    on_lane = np.flatnonzero(known & (scene.lane >= 0))
    lanes = [int(k) for k in scene.lane[on_lane]]
    paths = [road.path(k) for k in lanes]
    scale = np.array([p.scale for p in paths])
    arc = scene.lane_position[on_lane] * scale  # m, front bumper
    offset, drift = _sideways(scene, on_lane, paths, arc, c)
    aim = np.zeros(len(lanes))  # m, lateral offset from the path
    for i, k in enumerate(lanes):
        beside = road.lanes[k].left if offset[i] > 0.0 else road.lanes[k].right
        if drift[i] * offset[i] > 0.0:  # moving away from its own centre line
            if beside >= 0:
                paths[i] = road.path(beside)
            else:  # inside junctions lanes have no neighbours
                aim[i] = np.copysign(max(road.lanes[k].width, abs(offset[i])), offset[i])
    packed = pack(paths)
    arc, offset = project_many(*packed, *fronts(now[on_lane]), arc)
    moving = np.abs(drift) > 0.0
    rate = np.where(moving, np.clip(np.abs(drift), *c.drift_limits), c.settle_rate)
    end = np.array([p.length if p.dead_end else np.inf for p in paths])
    limit = np.array([road.lanes[k].speed_limit for k in lanes]) * c.speed_factor
    top = np.maximum(limit, now[on_lane, SPEED])[:, None] if len(lanes) else np.zeros((0, 1))
    along = roll(
        *packed,
        arc,
        offset,
        aim,
        now[on_lane, HEADING],
        rate,
        now[on_lane, LENGTH],
        np.minimum(speed[on_lane], top),
        end - 0.5,
        c.stop_brake,
        c.dt,
    )
    out = Rollout(*(np.zeros((count, frames + 1)) for _ in range(6)))
    for whole, part in zip(out, along, strict=True):
        whole[on_lane] = part
    lost = np.flatnonzero(known & (scene.lane < 0))
    if len(lost):
        _straight(out, now, forecast, speed, lost, m, c.dt)
    stream = dict(zip(on_lane.tolist(), paths, strict=True))
    drifting = np.zeros(count, np.bool_)
    drifting[on_lane] = moving
    return Traffic(out, now[:, LENGTH], now[:, WIDTH], tuple(map(stream.get, range(count))), drifting, known)


def _sideways(
    scene: Scene, rows: np.ndarray, paths: list[LanePath], arc: Floats, c: TrafficConfig
) -> tuple[Floats, Floats]:
    """The front's offset from its centre line [k] m, and its lateral speed [k] m/s (0 without a lane
    change)."""
    packed = pack(paths)
    _, offset = project_many(*packed, *fronts(scene.state[rows, -1]), arc)
    back = min(2, scene.state.shape[1] - 1)
    before = scene.state[rows, -1 - back]
    seen = scene.valid[rows, -1 - back] & (back > 0)
    _, earlier = project_many(*packed, *fronts(before), arc)
    drift = np.where(seen, (offset - earlier) / max(back * c.dt, c.dt), 0.0)
    changing = (np.abs(drift) > c.drift_rate) & (np.abs(offset) > c.drift_offset)
    return offset, np.where(changing, drift, 0.0)


def _straight(
    out: Rollout,
    now: Floats,
    forecast: KinematicForecast,
    speed: Floats,
    rows: np.ndarray,
    m: int,
    dt: float,
) -> None:
    """Vehicles off every lane: the forecast's own positions, then straight on."""
    for array, feature, ahead in ((out.x, X, forecast.x), (out.y, Y, forecast.y)):
        array[rows, : m + 1] = np.concatenate([now[rows, feature, None], ahead[rows, :m]], 1)
    out.heading[rows, : m + 1] = np.concatenate([now[rows, HEADING, None], forecast.heading[rows, :m]], 1)
    later = dt * np.arange(1, out.x.shape[1] - m)
    last = forecast.heading[rows, m - 1 : m]
    v = speed[rows, m : m + 1]
    out.x[rows, m + 1 :] = out.x[rows, m : m + 1] + v * np.cos(last) * later
    out.y[rows, m + 1 :] = out.y[rows, m : m + 1] + v * np.sin(last) * later
    out.heading[rows, m + 1 :] = last
    out.speed[rows] = speed[rows]
