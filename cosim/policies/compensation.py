"""Late states predicted to now by a predictor of the agent's, carried along the lanes as its mask does."""

import numpy as np

from cosim.road import RoadMap
from cosim.types import HEADING, SPEED, Bools, Floats, Ints, Timing, X, Y
from policy.prediction.lane import along_lanes
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import TrafficConfig

PREDICTORS = {"gp": "gp-indirect"}  # by the name of the compensation
PAST = 10  # frames, as of every history
HORIZON = 4.0  # s: older states are predicted no further


class AlongLanes:
    """`cosim.types.Compensator`: the predictor's speed along the lanes of `road`."""

    frames = PAST

    def __init__(self, name: str, road: RoadMap, timing: Timing) -> None:
        horizon = round(HORIZON / timing.frame)
        self._predictor = make_predictor(PREDICTORS[name], horizon, timing.frame)
        self._road, self._config = road, TrafficConfig(dt=timing.frame)

    def present(
        self, state: Floats, valid: Bools, lane: Ints, lane_position: Floats, length: Floats, age: Floats
    ) -> Floats:
        """See `Compensator.present`."""
        forecast = self._predictor.predict(state, valid)
        where = lane, lane_position, length, self._road
        led = along_lanes(forecast, state, valid, *where, self._config)
        columns = {X: led.x, Y: led.y, SPEED: led.speed, HEADING: led.heading}
        frames = np.minimum(age / self._predictor.dt, self._predictor.horizon - 1e-6)  # [V]
        before, share = frames.astype(np.int64), frames % 1.0
        rows, now = np.arange(len(state)), state[:, -1].copy()
        for column, ahead in columns.items():
            series = np.concatenate([now[:, column : column + 1], ahead], axis=1)  # [V,M+1]
            first, second = series[rows, before], series[rows, before + 1]
            now[:, column] = np.where(forecast.valid, first + share * (second - first), now[:, column])
        return now
