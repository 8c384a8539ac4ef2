"""`gp-lane`: the Gaussian process's speed carried along the vehicle's lane, as in the safety mask.

Not one of P's eight predictors: those do not know the road or the vehicle's position on it.
"""

import numpy as np

from cosim.road import RoadMap
from cosim.types import Bools, Floats, Ints
from policy.inputs.scene import Scene
from policy.prediction.forecast import KinematicForecast
from policy.prediction.traffic import TrafficConfig, predict_traffic


def along_lanes(
    forecast: KinematicForecast,
    state: Floats,
    valid: Bools,
    lane: Ints,
    lane_position: Floats,
    length: Floats,
    road: RoadMap,
    config: TrafficConfig | None = None,
) -> KinematicForecast:
    """`forecast` [V,M] of the vehicles state [V,N,4], valid [V,N] of one moment, led along their lanes.

    lane [V] index into `road.lanes`, -1 for none (the forecast is unchanged); lane_position [V] m of the
    front bumper; length [V] m. The standard deviations are unchanged.
    """
    count, frames = forecast.x.shape
    now = np.where(np.isfinite(state), state, 0.0)
    full = np.zeros((*state.shape[:2], 8))
    full[:, :, :4] = now
    full[:, :, 4], full[:, :, 5] = length[:, None], 2.0
    scene = Scene(
        agents=(),
        histories=(),
        vehicles=tuple(map(str, range(count))),
        state=full,
        valid=valid & np.isfinite(state).all(2),
        lane=lane.astype(np.int32),
        lane_position=lane_position,
        row=np.zeros((0, 0), np.int64),
        pose=np.zeros((0, 3)),
        shared=True,
    )
    led = predict_traffic(scene, forecast, road, config or TrafficConfig(), frames).rollout
    there = forecast.valid[:, None]
    return forecast._replace(
        x=np.where(there, led.x[:, 1:], 0.0),
        y=np.where(there, led.y[:, 1:], 0.0),
        speed=np.where(there, led.speed[:, 1:], 0.0),
        heading=np.where(there, led.heading[:, 1:], 0.0),
    )
