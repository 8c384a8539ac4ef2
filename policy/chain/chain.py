"""The multi-step prediction chain (P, algorithm 1): the next seconds of all AVs as maps and kinematics."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch

from cosim.errors import in_range
from cosim.geometry.raster import PIXEL_LOWEST, PIXEL_SPAN, PIXEL_SPEED, RoadRaster, draw_kinematics
from cosim.types import SPEED, Bools, Bytes, Floats, ObservationConfig
from policy.inputs.scene import Scene, pictured, rows_ahead
from policy.inputs.tensors import Batch, kinematic_tensor, unit
from policy.networks.hpn import HPN
from policy.networks.kinematic_branch import Corrected, apply
from policy.networks.map_branch import MapBranch
from policy.prediction.forecast import KinematicForecast
from policy.prediction.traffic import Traffic
from policy.prediction.vehicle_inputs import vehicle_inputs


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """Options of the prediction chain in a training configuration."""

    every: int = 5  # the VFN takes every fifth frame, M = 4; paper: 1, M = 20
    source: Literal["hpn", "gp_raster"] = "hpn"  # gp_raster: maps rendered from the uncorrected forecast


@dataclass(frozen=True, slots=True)
class ChainConfig(Hypotheses):
    """The prediction of the next seconds (observation.md, Clocks)."""

    horizon: int = 20  # frames of 0.2 s: 4 s (P, Table I)

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(self, positive="horizon every")

    @property
    def hypotheses(self) -> int:
        """M, the number of predicted frames in the VFN's input."""
        return self.horizon // self.every


class Prediction(NamedTuple):
    """The M = horizon / every hypotheses of every AV."""

    maps: torch.Tensor  # [B,M,C,H,W] each in the predicted ego's frame: uint8 as drawn, or float32 as decoded
    kinematics: torch.Tensor  # [B,M,R,F+1] scaled; the Gaussian process's (P, eq. 10), corrected by the HPN
    rows: Floats  # [B,horizon,R,8] every frame in m, m/s, rad, in the ego's frame at the newest frame
    valid: Bools  # [B,R]


def render(rows: Floats, valid: Bools, pose: Floats, config: ObservationConfig, raster: RoadRaster) -> Bytes:
    """Maps of predicted kinematics.

    Args:
        rows: [B,M,k,8] KINEMATIC_FEATURES in each ego's frame (m, m/s, rad), row 0 the ego.
        valid: [B,k] rows that hold a vehicle.
        pose: [B,3] present x m, y m, heading rad of each ego.
        config: size and channels of the maps.
        raster: the road.

    Returns:
        uint8 [B,M,C,H,W].
    """
    b, m, r, f = rows.shape
    out = np.empty((b * m, len(config.channels), config.height, config.width), np.uint8)
    flat = np.ascontiguousarray(rows.reshape(b * m, r, f))
    draw_kinematics(out, flat, np.repeat(valid, m, 0), np.repeat(pose, m, 0), raster, config)
    return out.reshape(b, m, *out.shape[1:])


def shade(rows: Floats, share: Floats) -> Floats:
    """Rows [B,M,k,8] (row 0 the ego) whose pixels are darkened to share [B,M,k] of their value.

    A vehicle with an expected overlap of one half is drawn with half of its pixel value: the expected
    picture, which has the least squared error. The value stays above PIXEL_LOWEST, so no vehicle vanishes.
    """
    out = rows.copy()
    ego, top = rows[..., :1, SPEED], PIXEL_SPEED
    level = PIXEL_LOWEST + PIXEL_SPAN * np.clip((rows[..., SPEED] - ego + top) / (2 * top), 0.0, 1.0)
    shaded = np.maximum(level * share, PIXEL_LOWEST) - PIXEL_LOWEST
    out[..., SPEED] = ego + shaded * (2 * top / PIXEL_SPAN) - top
    out[..., 0, SPEED] = ego[..., 0]
    return out


def predict(
    config: ChainConfig,
    observation: ObservationConfig,
    raster: RoadRaster,
    hpn: HPN | None,
    scene: Scene,
    batch: Batch,
    forecast: KinematicForecast,
    traffic: Traffic | None = None,
) -> Prediction:
    """The next seconds of all AVs in one batch (P, algorithm 1).

    Args:
        config: horizon and returned frames.
        observation: size and channels of the maps.
        raster: the road from `cosim.geometry.raster.rasterize_road`.
        hpn: the network; None: the maps are rendered from the uncorrected forecast.
        scene: the AVs' joined knowledge (`policy.inputs.scene.join`).
        batch: the AVs' observations (`policy.inputs.tensors.to_batch`), on the device of the network.
        forecast: world states of all vehicles of `scene` (m, m/s, rad), at least `horizon` frames.
        traffic: the same speeds along the lanes, required by a kinematic branch.

    Returns:
        maps, kinematics and rows of B AVs, M = horizon / every frames.

    Raises:
        ValueError: the `hpn` has a kinematic branch and there is no `traffic`.
    """
    device = str(batch.maps.device)
    corrected: Corrected | None = None
    if hpn is not None and hpn.kinematic is not None:
        if traffic is None:
            raise ValueError("the kinematic branch needs the traffic along the lanes")
        corrected = apply(hpn.kinematic, vehicle_inputs(scene, forecast, traffic), forecast)
        forecast = corrected.forecast
    m, every = config.horizon, config.every
    states = (forecast.x[:, :m], forecast.y[:, :m], forecast.speed[:, :m], forecast.heading[:, :m])
    rows, valid = rows_ahead(scene, *states)
    kinematics = kinematic_tensor(rows, np.repeat(valid[:, None], m, 1), device)
    branch = None if hpn is None else hpn.map_branch
    if branch is None:
        drawn = _rendered(scene, states, corrected, slice(every - 1, None, every), observation, raster)
        return Prediction(torch.from_numpy(drawn).to(device), kinematics[:, every - 1 :: every], rows, valid)
    reference = None
    if branch.config.correct:
        reference = _rendered(scene, states, corrected, slice(None), observation, raster)
    maps = _chain(branch, config, batch, kinematics, reference)
    return Prediction(maps, kinematics[:, every - 1 :: every], rows, valid)


def _rendered(
    scene: Scene,
    states: tuple[Floats, Floats, Floats, Floats],
    corrected: Corrected | None,
    wanted: slice,
    observation: ObservationConfig,
    raster: RoadRaster,
) -> Bytes:
    """Maps [B,.,C,H,W] of the wanted frames, with the vehicles known to each AV."""
    x, y, speed, heading = (a[:, wanted] for a in states)
    raster.show(scene.histories[0].signals)  # present signal states: their future is unknown
    c = observation
    corner = 0.5 * float(np.hypot(c.height * c.metres_across, c.width * c.metres_along))  # m
    rows, known, index = pictured(scene, x, y, speed, heading, corner + 1.0)
    if corrected is not None:
        share = corrected.share(index)[..., : states[0].shape[1]][..., wanted]  # [B,k,M]
        rows = shade(rows, share.transpose(0, 2, 1))
    return render(rows, known, scene.pose, observation, raster)


def _chain(
    branch: MapBranch, config: ChainConfig, batch: Batch, kinematics: torch.Tensor, rendered: Bytes | None
) -> torch.Tensor:
    """The map branch, block after block: its maps and the forecast kinematics are the next block's past."""
    m, device = config.horizon, batch.maps.device
    n, block, channels = branch.config.seen, branch.config.block, batch.maps.shape[2]
    b, _, _, h, w = batch.maps.shape
    # channels_last from here on: every frame is a group of channels
    past = _grouped(batch.maps[:, -n:])
    moved = batch.kinematics[:, -n:]
    guesses = []
    for start in range(0, m, block):
        drawn = None
        if rendered is not None:
            ahead = rendered[:, start : start + block]
            if ahead.shape[1] < block:  # the horizon ends within this block
                ahead = np.concatenate([ahead, np.repeat(ahead[:, -1:], block - ahead.shape[1], 1)], 1)
            drawn = _grouped(torch.from_numpy(ahead).to(device))
        guess, _ = branch(past, moved, drawn)  # the branch's K is replaced by the GP's (eq. 10)
        guess = guess.clamp_(0.0, 1.0)
        frames = guess.view(b, block, channels, h, w)
        guesses += [frames[:, k] for k in range(block) if (start + k + 1) % config.every == 0]
        if start + block < m:
            past = torch.cat([past, guess], 1)[:, -n * channels :]
            moved = torch.cat([moved, kinematics[:, start : start + block]], 1)[:, -n:]
    return torch.stack(guesses[: config.hypotheses], 1)


def _grouped(maps: torch.Tensor) -> torch.Tensor:
    """[B,T,C,H,W] pixels -> [B,T*C,H,W] in [0,1], in channels_last."""
    return unit(maps).flatten(1, 2).contiguous(memory_format=torch.channels_last)
