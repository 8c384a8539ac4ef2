"""The multi-step prediction chain (P, algorithm 1): all AVs' next seconds as maps and kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch

from cosim.raster import RoadRaster, channel_indices, draw_rows
from cosim.types import Bools, Bytes, Floats, ObservationConfig
from policy.forecast import KinematicForecast
from policy.hpn import HPN
from policy.scene import Scene, rows_ahead
from policy.tensors import Batch, kinematic_tensor, map_tensor


@dataclass(frozen=True, slots=True)
class ChainConfig:
    """How the next seconds are predicted (contract.md, Time)."""

    horizon: int = 20  # frames of 0.2 s: 4 s (P, Table I)
    every: int = 5  # the VFN takes every fifth frame, M = 4; paper: 1, M = 20
    source: Literal["hpn", "gp_raster"] = "hpn"  # gp_raster: the rendered maps as they are

    @property
    def hypotheses(self) -> int:
        """M, the predicted frames that the VFN sees."""
        return self.horizon // self.every


class Prediction(NamedTuple):
    """The M = horizon / every hypotheses of every AV."""

    maps: torch.Tensor  # [B,M,C,H,W] float32 in [0,1], each in the predicted ego's frame
    kinematics: torch.Tensor  # [B,M,R,F+1] scaled; by the GP (P, eq. 10)
    rows: Floats  # [B,horizon,R,8] every frame in m, m/s, rad, in the ego's frame at the newest frame
    valid: Bools  # [B,R]


def render(rows: Floats, valid: Bools, pose: Floats, config: ObservationConfig, raster: RoadRaster) -> Bytes:
    """Maps of predicted kinematics: rows [B,M,R,8], valid [B,R], pose [B,3] -> uint8 [B,M,C,H,W]."""
    b, m, r, f = rows.shape
    out = np.empty((b * m, len(config.channels), config.height, config.width), np.uint8)
    draw_rows(
        out,
        np.ascontiguousarray(rows.reshape(b * m, r, f)),
        np.repeat(valid, m, 0),
        np.repeat(pose, m, 0),
        channel_indices(config),
        config.metres_across,
        config.metres_along,
        raster.cells,
        raster.x,
        raster.y,
        raster.cell,
    )
    return out.reshape(b, m, *out.shape[1:])


def predict(
    config: ChainConfig,
    observation: ObservationConfig,
    raster: RoadRaster,
    hpn: HPN | None,
    scene: Scene,
    batch: Batch,
    forecast: KinematicForecast,
) -> Prediction:
    """Algorithm 1, batched over all AVs; the GP corrects the kinematics at every step (eq. 10).

    `forecast`: the predicted states of all vehicles of `scene` in the world, at least `horizon` frames.
    Without an `hpn` the maps rendered from the forecast are returned.
    """
    m, device = config.horizon, str(batch.maps.device)
    rows, valid = rows_ahead(
        scene, forecast.x[:, :m], forecast.y[:, :m], forecast.speed[:, :m], forecast.heading[:, :m]
    )
    kinematics = kinematic_tensor(rows, np.repeat(valid[:, None], m, 1), device)
    rendered = None
    if hpn is None or hpn.config.correct:
        rendered = render(rows, valid, scene.pose, observation, raster)
        if hpn is None:
            wanted = slice(config.every - 1, None, config.every)
            return Prediction(map_tensor(rendered[:, wanted], device), kinematics[:, wanted], rows, valid)
    n, block, channels = hpn.config.seen, hpn.config.block, batch.maps.shape[2]
    b, _, _, h, w = batch.maps.shape
    # channels_last from here on: every frame is a group of channels, the window a few such groups
    past = [_grouped(batch.maps[:, -n:])]
    moved = batch.kinematics[:, -n:]
    guesses = []
    for start in range(0, m, block):
        drawn = None
        if rendered is not None:
            ahead = rendered[:, start : start + block]
            if ahead.shape[1] < block:  # the horizon ends within this block
                ahead = np.concatenate([ahead, np.repeat(ahead[:, -1:], block - ahead.shape[1], 1)], 1)
            drawn = _grouped(torch.from_numpy(ahead).to(device)).to(torch.float32).mul_(1.0 / 255.0)
        guess, _ = hpn(past, moved, drawn)  # its own K is replaced by the GP's (eq. 10)
        guess = guess.clamp_(0.0, 1.0)
        frames = guess.view(b, block, channels, h, w)
        guesses += [frames[:, k] for k in range(block) if (start + k + 1) % config.every == 0]
        if start + block < m:
            past = _newest([*past, guess], n * channels)
            moved = torch.cat([moved, kinematics[:, start : start + block]], 1)[:, -n:]
    maps = torch.stack(guesses[: config.hypotheses], 1)
    return Prediction(maps, kinematics[:, config.every - 1 :: config.every], rows, valid)


def _grouped(maps: torch.Tensor) -> torch.Tensor:
    """[B,T,C,H,W] -> [B,T*C,H,W] in channels_last."""
    return maps.flatten(1, 2).contiguous(memory_format=torch.channels_last)


def _newest(groups: list[torch.Tensor], wanted: int) -> list[torch.Tensor]:
    """The last `wanted` channels of channel groups [B,.,H,W], oldest first."""
    kept: list[torch.Tensor] = []
    for group in reversed(groups):
        kept.insert(0, group[:, -wanted:])
        wanted -= kept[0].shape[1]
        if wanted <= 0:
            break
    return kept
