"""Delay compensation with the agent's predictors: the Gaussian process, or the HPN."""

from collections.abc import Callable

import numpy as np

from cosim.road import RoadMap
from cosim.types import HEADING, SPEED, Compensator, Floats, Timing, Tracks, X, Y
from policy.chain.late import LateStates
from policy.prediction.forecast import KinematicForecast
from policy.prediction.lane import along_lanes
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import TrafficConfig

GP, HPN = "gp", "hpn"  # compensations
PAST = 10  # frames, as in every history
HORIZON = 4.0  # s, cap of the predicted time


class GaussianProcess:
    """`cosim.types.Compensator`: the Gaussian process's speed along the lanes of `road`."""

    frames = PAST

    def __init__(self, road: RoadMap, timing: Timing) -> None:
        self._predictor = make_predictor("gp-indirect", round(HORIZON / timing.frame), timing.frame)
        self._road, self._config = road, TrafficConfig(dt=timing.frame)

    def present(self, tracks: Tracks) -> Floats:
        """See `Compensator.present`."""
        t = tracks
        forecast = self._predictor.predict(t.state, t.valid)
        where = t.lane, t.lane_position, t.length, self._road
        return _at(along_lanes(forecast, t.state, t.valid, *where, self._config), t, self._config.dt)


class HybridPredictiveNetwork:
    """`cosim.types.Compensator`: the shipped HPN's correction of that, for each AV's own tracks."""

    frames = PAST

    def __init__(self, road: RoadMap, timing: Timing) -> None:
        self._states, self._frame = LateStates(road, timing), timing.frame

    def present(self, tracks: Tracks) -> Floats:
        """See `Compensator.present`."""
        return _at(self._states.ahead(tracks), tracks, self._frame)


COMPENSATORS: dict[str, Callable[[RoadMap, Timing], Compensator]] = {
    GP: GaussianProcess,
    HPN: HybridPredictiveNetwork,
}


def _at(forecast: KinematicForecast, tracks: Tracks, dt: float) -> Floats:
    """[V,4] a forecast [V,M] with frames of `dt` s, interpolated at the age of each track."""
    horizon = forecast.x.shape[1]
    columns = {X: forecast.x, Y: forecast.y, SPEED: forecast.speed, HEADING: forecast.heading}
    frames = np.minimum(tracks.age / dt, horizon - 1e-6)  # [V]
    before, share = frames.astype(np.int64), frames % 1.0
    rows, now = np.arange(len(tracks.state)), tracks.state[:, -1].copy()
    for column, ahead in columns.items():
        series = np.concatenate([now[:, column : column + 1], ahead], axis=1)  # [V,M+1]
        first, second = series[rows, before], series[rows, before + 1]
        now[:, column] = np.where(forecast.valid, first + share * (second - first), now[:, column])
    return now
