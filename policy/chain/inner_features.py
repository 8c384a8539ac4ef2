"""The inner features of a trained HPN, as pictures (P, figure 7)."""

from collections.abc import Mapping

import numpy as np
import torch

from cosim.geometry.raster import rasterize_road
from cosim.road import RoadMap
from cosim.types import Floats, Floats32, History, ObservationConfig
from policy.chain.chain import render
from policy.inputs.scene import Scene, join, pictured
from policy.inputs.tensors import to_batch, to_numpy, unit
from policy.networks.hpn import HPN
from policy.prediction.predictors import Predictor
from policy.prediction.traffic import TrafficConfig, foresee
from policy.prediction.vehicle_inputs import vehicle_inputs

SHOWN_FEATURES = 8  # features shown per layer, those of largest variance


def feature_pictures(
    hpns: Mapping[str, HPN],
    histories: Mapping[str, History],
    av: str,
    observation: ObservationConfig,
    road: RoadMap,
    predictor: Predictor,
) -> dict[str, Floats32]:
    """Layer -> pictures [k,h,w] in [0,1] in the frame of the AV `av`.

    Features of the map branch are pictures already. Features of the kinematic branch belong to vehicles: each
    vehicle is drawn at its present position with its feature as brightness.
    """
    scene = join(histories, observation.share_perception)
    b = scene.agents.index(av)
    out: dict[str, Floats32] = {}
    with torch.inference_mode():
        for name, hpn in hpns.items():
            if hpn.kinematic is not None:
                known = scene if hpn.kinematic.config.history else scene.without_history()
                inputs = vehicle_inputs(known, *foresee(known, predictor, road, TrafficConfig()))
                features = hpn.kinematic.features(torch.from_numpy(inputs.own), torch.from_numpy(inputs.near))
                values = to_numpy(features) * inputs.known[:, None]
                out[f"{name}, vehicles"] = _vehicle_pictures(values, scene, b, observation, road)
            if hpn.map_branch is not None and not hpn.map_branch.config.correct:
                seen = to_batch(scene.histories).maps[b : b + 1, -hpn.map_branch.config.seen :]
                for layer, maps in enumerate(hpn.map_branch.encode(unit(seen).flatten(1, 2))[1]):
                    out[f"{name}, layer {layer + 1}"] = _scaled(to_numpy(maps[0]))
    return out


def _vehicle_pictures(
    values: Floats32, scene: Scene, b: int, observation: ObservationConfig, road: RoadMap
) -> Floats32:
    """[k,H,W]: the features [V,.] of largest variance, drawn at the vehicles."""
    chosen = np.argsort(-values.std(0))[:SHOWN_FEATURES]
    now = scene.state[:, -1]
    x, y, heading = (now[:, k : k + 1] for k in (0, 1, 3))
    raster = rasterize_road(road)
    out = []
    for feature in chosen:
        level = values[:, feature] / max(float(values[:, feature].max()), 1e-9)
        speed: Floats = 60.0 * level[:, None].astype(np.float64) - 30.0  # the rasteriser's brightness
        rows, known, _ = pictured(scene, x, y, speed, heading)
        ego = rows[b : b + 1].copy()
        ego[..., 0, 2] = 0.0  # brightness encodes the speed relative to the ego
        maps = render(ego, known[b : b + 1], scene.pose[b : b + 1], observation, raster)[0, 0]
        road_channel = observation.channels.index("road")
        vehicles = np.delete(maps, road_channel, 0).max(0).astype(np.float32) / 255.0
        out.append(np.maximum(vehicles, 0.08 * (maps[road_channel] > 0)))
    return np.stack(out).astype(np.float32)


def _scaled(maps: Floats32) -> Floats32:
    """The SHOWN_FEATURES features [k,h,w] of largest variance over the picture, each from 0 to 1."""
    most = maps[np.argsort(-maps.std((1, 2)))[:SHOWN_FEATURES]]
    low, high = most.min((1, 2), keepdims=True), most.max((1, 2), keepdims=True)
    return np.asarray((most - low) / np.maximum(high - low, 1e-9), np.float32)
