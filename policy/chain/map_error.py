"""Error of predicted maps against the true ones: PRE and occupancy IoU (observation.md)."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from cosim.geometry.raster import RoadRaster, rasterize_road
from cosim.road import RoadMap
from cosim.types import Bytes, Floats, Floats32, History, ObservationConfig
from policy.chain.chain import ChainConfig, predict
from policy.inputs.scene import join
from policy.inputs.tensors import to_batch, to_numpy, unit
from policy.networks.hpn import HPN
from policy.prediction.predictors import Predictor
from policy.prediction.traffic import TrafficConfig, foresee

OCCUPIED = 0.05  # a pixel above this is occupied (figures.md: IoU)
HORIZONS = (0.2, 0.4, 1.0, 2.0, 3.0, 4.0)  # s (observation.md, Clocks)


def frame_of(horizon: float, dt: float = 0.2) -> int:
    """Index of a horizon (s) among the predicted frames."""
    return round(horizon / dt) - 1


def vehicle_channels(config: ObservationConfig) -> npt.NDArray[np.int64]:
    """Channels that show vehicles: all except the road."""
    return np.array([k for k, name in enumerate(config.channels) if name != "road"], np.int64)


def picture_error(
    predicted: Floats32 | Bytes, true: Bytes, channels: npt.NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """PRE (mean squared error per vehicle pixel) and IoU of maps [...,C,H,W]; uint8 counts as 255 = 1.

    The IoU of two empty maps is 1.
    """
    axes = (-3, -2, -1)
    p, t = (unit_maps(a[..., channels, :, :]) for a in (predicted, true))
    pre = ((p - t) ** 2).mean(axes, dtype=np.float64)
    a, b = p > OCCUPIED, t > OCCUPIED
    union = (a | b).sum(axes)
    return pre, np.where(union > 0, (a & b).sum(axes) / np.maximum(union, 1), 1.0)


def unit_maps(maps: Floats32 | Bytes) -> Floats32:
    """Maps of any shape, uint8 pixels or float32 in [0,1] already -> float32 in [0,1]."""
    scale = 255.0 if maps.dtype == np.uint8 else 1.0
    return np.asarray(maps, np.float32) / np.float32(scale)


class Guess(NamedTuple):
    """Predicted maps of B AVs, in the order of `agents`."""

    agents: tuple[str, ...]
    maps: dict[str, Floats32]  # predictor -> [B,M,C,H,W], every frame of the horizon


class MapPredictors:
    """The predictors of the table: repetition of the last frame, the rendered forecast, and trained HPNs.

    All use the forecast of `predictor`; an HPN without history gets the forecast of the newest frame alone.
    """

    def __init__(
        self, hpns: Mapping[str, HPN], predictor: Predictor, observation: ObservationConfig, road: RoadMap
    ) -> None:
        self._hpns, self._predictor, self._observation, self._road = hpns, predictor, observation, road
        self._raster: RoadRaster = rasterize_road(road, observation.road_version)
        self._traffic = TrafficConfig()

    def predict(self, histories: Mapping[str, History]) -> Guess:
        """Maps of the whole horizon, frame by frame."""
        config = ChainConfig(horizon=self._predictor.horizon, every=1)
        scene = join(histories, self._observation.share_perception)
        last = np.stack([h.velocity_map[-1] for h in scene.histories])
        maps = {"last-frame": np.repeat(unit_maps(last)[:, None], config.horizon, 1)}
        with torch.inference_mode():
            batch = to_batch(scene.histories)
            for name in ("gp-raster", *self._hpns):
                hpn = self._hpns.get(name)
                history = hpn is None or hpn.kinematic is None or hpn.kinematic.config.history
                known = scene if history else scene.without_history()
                forecast, traffic = foresee(known, self._predictor, self._road, self._traffic)
                guess = predict(config, self._observation, self._raster, hpn, known, batch, forecast, traffic)
                maps[name] = to_numpy(unit(guess.maps))
        return Guess(scene.agents, maps)
