"""Training examples of supervised learners: one decision of a recorded episode and the true future."""

import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cosim.road import RoadMap
from cosim.types import Bools, Bytes, Floats, Floats32, History, Ints, Snapshot
from policy.inputs.scene import join
from policy.prediction.predictors import Predictor
from policy.prediction.traffic import TrafficConfig, foresee
from policy.prediction.vehicle_inputs import vehicle_inputs

FULL_TURN = 2 * np.pi


class Moment(NamedTuple):
    """V vehicles and the B observing AVs. Coordinates relative to one origin per moment (float32)."""

    own: Floats32  # [V,.] `VehicleInputs`
    near: Floats32  # [V,K,.]
    lane: Floats32  # [V,M,4] x m, y m, speed m/s, heading rad
    gp: Floats32  # [V,M,4]
    truth: Floats32  # [V,M,4] nan after the vehicle left
    known: Bools  # [V]
    ego: Ints  # [B] indices of the AVs


class MapSample(NamedTuple):
    """One AV at one decision: its past and future maps, compressed (they are nearly empty)."""

    maps: bytes  # zlib of uint8 [N+M,C,H,W]
    shape: tuple[int, ...]
    kinematics: Floats32  # [N,R,8] as in `History`
    valid: Bools  # [N,R]
    next_kinematics: Floats32  # [M,R,8] the same rows later; only the first four columns are defined
    next_valid: Bools  # [M,R]

    def unpacked(self) -> Bytes:
        """uint8 [N+M,C,H,W]"""
        return np.frombuffer(zlib.decompress(self.maps), np.uint8).reshape(self.shape)


def moment(
    histories: Mapping[str, History],
    future: Sequence[Snapshot],
    road: RoadMap,
    predictor: Predictor,
    config: TrafficConfig,
    history: bool = True,
) -> Moment:
    """One decision as a training example of the kinematic branch; `future`: the next M frames."""
    scene = join(histories)
    if not history:
        scene = scene.without_history()
    inputs = vehicle_inputs(scene, *foresee(scene, predictor, road, config))
    truth = states_of(scene.vehicles, future)  # [V,M,4]
    truth[..., 3] -= FULL_TURN * np.round((truth[..., 3] - inputs.lane[..., 3]) / FULL_TURN)
    origin = np.array([*scene.pose[0, :2], 0.0, 0.0])
    lane, gp, later = (np.asarray(a - origin, np.float32) for a in (inputs.lane, inputs.gp, truth))
    return Moment(inputs.own, inputs.near, lane, gp, later, inputs.known, scene.ego)


def states_of(vehicles: Sequence[str], frames: Sequence[Snapshot]) -> Floats:
    """[V,M,4] x y speed heading of the vehicles in every frame; nan for vehicles off the road."""
    out = np.full((len(vehicles), len(frames), 4), np.nan)
    for k, frame in enumerate(frames):
        at = np.array([frame.row.get(name, -1) for name in vehicles], np.int64)
        here = at >= 0
        rows = at[here]
        out[here, k] = np.stack([frame.x[rows], frame.y[rows], frame.speed[rows], frame.heading[rows]], 1)
    return out


def map_sample(history: History, maps: Bytes, future: Sequence[Snapshot]) -> MapSample:
    """One AV at one decision; maps [M,C,H,W] are its true maps of the next M frames."""
    states = states_of(history.ids, future)  # [R,M,4]
    there = np.isfinite(states[..., 0]) & history.valid[-1][:, None]
    x, y, heading = history.pose
    c, s = np.cos(heading), np.sin(heading)
    dx, dy = states[..., 0] - x, states[..., 1] - y
    after = np.zeros((len(future), *history.kinematics.shape[1:]), np.float32)
    turned = states[..., 3] - heading
    turned -= FULL_TURN * np.round((turned - history.kinematics[-1, :, None, 3]) / FULL_TURN)
    for k, value in enumerate((c * dx + s * dy, c * dy - s * dx, states[..., 2], turned)):
        after[..., k] = np.where(there, value, 0.0).T
    after[..., 4:] = history.kinematics[-1, :, 4:]
    whole = np.concatenate([history.velocity_map, maps])
    return MapSample(
        zlib.compress(whole.tobytes(), 1),
        whole.shape,
        history.kinematics.copy(),
        history.valid.copy(),
        after,
        np.ascontiguousarray(there.T),
    )
