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
    """Every predicted frame of every AV."""

    maps: torch.Tensor  # [B,horizon,C,H,W] float32 in [0,1], each in the predicted ego's frame
    kinematics: torch.Tensor  # [B,horizon,R,F+1] scaled; by the GP (P, eq. 10)
    rows: Floats  # [B,horizon,R,8] the same in m, m/s, rad in the ego's frame at the newest frame
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
    m = config.horizon
    rows, valid = rows_ahead(
        scene, forecast.x[:, :m], forecast.y[:, :m], forecast.speed[:, :m], forecast.heading[:, :m]
    )
    mask = np.repeat(valid[:, None], m, 1)
    kinematics = kinematic_tensor(rows, mask, str(batch.maps.device))
    if hpn is None or hpn.config.correct:
        rendered = map_tensor(render(rows, valid, scene.pose, observation, raster), str(batch.maps.device))
        if hpn is None:
            return Prediction(rendered, kinematics, rows, valid)
    else:
        rendered = None
    n, block = hpn.config.frames, hpn.config.block
    seen_maps, seen_kinematics = batch.maps[:, -n:], batch.kinematics[:, -n:]
    maps = []
    for start in range(0, m, block):
        ahead = rendered[:, start : start + block] if rendered is not None else None
        if ahead is not None and ahead.shape[1] < block:
            ahead = torch.cat([ahead, ahead[:, -1:].expand(-1, block - ahead.shape[1], -1, -1, -1)], 1)
        guess, _ = hpn(seen_maps, seen_kinematics, ahead)  # its own K is replaced by the GP's
        guess = guess.clamp(0.0, 1.0)
        maps.append(guess)
        if start + block < m:
            seen_maps = torch.cat([seen_maps, guess], 1)[:, -n:]
            known = kinematics[:, start : start + block]
            seen_kinematics = torch.cat([seen_kinematics, known], 1)[:, -n:]
    return Prediction(torch.cat(maps, 1)[:, :m], kinematics, rows, valid)
