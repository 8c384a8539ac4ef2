"""Delay compensation by the HPN's kinematic branch: late states are predicted to now, for each AV alone."""

import numpy as np
import torch

from cosim.errors import BadInput
from cosim.road import RoadMap
from cosim.types import Timing, Tracks
from policy.checkpoint import SHIPPED, load
from policy.inputs.scene import Scene
from policy.networks.hpn import HPN, HpnConfig
from policy.networks.kinematic_branch import apply
from policy.prediction.forecast import KinematicForecast
from policy.prediction.gp import GaussianProcessIndirect
from policy.prediction.motion import Rollout
from policy.prediction.traffic import Traffic, TrafficConfig, foresee
from policy.prediction.vehicle_inputs import FRAME_S, VehicleInputs, vehicle_inputs

MIN_FRAMES = 5  # shortest past that the branch corrects: training had few shorter ones


class LateStates:
    """The shipped HPN on tracks. Raises BadInput for another frame time than in training."""

    def __init__(self, road: RoadMap, timing: Timing) -> None:
        if abs(timing.frame - FRAME_S) > 1e-9:
            problem = f"the HPN was trained with frames of {FRAME_S:g} s"
            raise BadInput(problem, field="compensation", value=f"hpn with frames of {timing.frame:g} s")
        hpn = HPN(HpnConfig())
        load(SHIPPED / "hpn.safetensors", {"hpn": hpn}, {"hpn": hpn.config})
        assert hpn.kinematic is not None
        self._branch = hpn.kinematic.eval()
        self._road, self._config = road, TrafficConfig(dt=timing.frame)
        self._predictor = GaussianProcessIndirect(hpn.kinematic.config.horizon, timing.frame)

    def ahead(self, tracks: Tracks) -> KinematicForecast:
        """[V,M] the states that follow those of `tracks`.

        Persons and tracks shorter than MIN_FRAMES get the Gaussian process's forecast along the lanes.
        """
        scene = _scene(tracks)
        forecast, traffic = foresee(scene, self._predictor, self._road, self._config)
        inputs = _inputs_by_owner(scene, forecast, traffic, tracks)
        with torch.inference_mode():
            corrected = apply(self._branch, inputs, forecast).forecast
        lane = inputs.lane[:, : corrected.x.shape[1]]
        uncorrected = (tracks.person | (tracks.valid.sum(1) < MIN_FRAMES))[:, None]
        names = ("x", "y", "speed", "heading")
        x, y, speed, heading = (
            np.where(uncorrected, lane[..., k], getattr(corrected, n)) for k, n in enumerate(names)
        )
        return KinematicForecast.without_spread(x, y, speed, heading, inputs.known)


def _scene(tracks: Tracks) -> Scene:
    """All tracks as one scene without a deciding AV."""
    count, frames = tracks.valid.shape
    state = np.zeros((count, frames, 8))
    state[..., :4] = np.nan_to_num(tracks.state)
    fixed = tracks.length, tracks.width, tracks.is_av, tracks.is_mission
    state[..., 4:] = np.stack(fixed, 1)[:, None]
    names = tuple(map(str, range(count)))
    lane = tracks.lane.astype(np.int32)
    nobody = np.zeros((0, 0), np.int64), np.zeros((0, 3))
    return Scene((), (), names, state, tracks.valid, lane, tracks.lane_position, *nobody, shared=True)


def _inputs_by_owner(
    scene: Scene, forecast: KinematicForecast, traffic: Traffic, tracks: Tracks
) -> VehicleInputs:
    """The branch's inputs. Neighbours are tracks of the same AV; persons are no neighbours."""
    parts = []
    order = np.argsort(tracks.owner, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(tracks.owner[order])) + 1):
        valid = scene.valid[rows] & ~tracks.person[rows, None]
        mine = scene._replace(
            vehicles=tuple(scene.vehicles[k] for k in rows),
            state=scene.state[rows],
            valid=valid,
            lane=scene.lane[rows],
            lane_position=scene.lane_position[rows],
        )
        led = Traffic(
            Rollout._make(a[rows] for a in traffic.rollout),
            traffic.length[rows],
            traffic.width[rows],
            tuple(traffic.stream[k] for k in rows),
            traffic.drifting[rows],
            traffic.known[rows],
        )
        parts.append(vehicle_inputs(mine, KinematicForecast._make(a[rows] for a in forecast), led))
    back = np.argsort(order)
    return VehicleInputs._make(np.concatenate(columns)[back] for columns in zip(*parts, strict=True))
