"""The only conversion between numpy and torch: histories in, network inputs out, action values back."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from cosim.geometry.compiled import compiled
from cosim.geometry.raster import PIXEL_LOWEST, PIXEL_SPAN, PIXEL_SPEED
from cosim.road import RoadMap
from cosim.types import KINEMATIC_FEATURES, Bools, Bytes, Floats, Floats32, History
from policy.inputs.situation import situation

# Scales that bring every kinematic feature to about [-1, 1]: row range, map half width, motorway speed,
# a U-turn, a lorry; is_av and is_mission are not scaled.
KINEMATIC_SCALE = np.array([125.0, 16.0, 30.0, np.pi, 10.0, 3.0, 1.0, 1.0], np.float32)
KINEMATIC_INPUTS = len(KINEMATIC_FEATURES) + 1  # the features and the mask

PLANE_CHANNELS = ("av", "hv", "road", "mission")  # channels that `to_planes` reads
PLANES = 5  # channels of `to_planes`: AV, HV, road, ego or mission vehicle, relative speed
EQUAL_SPEED_PIXEL = 255 * (PIXEL_LOWEST + PIXEL_SPAN / 2)  # pixel value of a vehicle at the ego's speed
_LEVEL = np.float32(1.0 / 255.0)
PIXEL_PER_15_MPS = 255 * PIXEL_SPAN / (2 * PIXEL_SPEED) * 15.0  # 1.0 in `to_planes`
# [256] pixel value -> relative speed in units of 15 m/s; 0 for pixels without a vehicle
_RELATIVE = np.where(
    np.arange(256) > 0,
    (np.arange(256, dtype=np.float32) - np.float32(EQUAL_SPEED_PIXEL)) * np.float32(1.0 / PIXEL_PER_15_MPS),
    np.float32(0.0),
)


class States(NamedTuple):
    """Inputs of a value network for B AVs; T = N past and M predicted frames."""

    maps: torch.Tensor  # [B,T,C,H,W] uint8 pixels: bytes until a convolution reads them
    kinematics: torch.Tensor  # [B,T,R,F+1] scaled
    situation: torch.Tensor  # [B,SITUATION_INPUTS]
    phi: torch.Tensor  # [B,2]


class Batch(NamedTuple):
    """Observations of B AVs."""

    maps: torch.Tensor  # [B,N,C,H,W] uint8 pixels: bytes until a convolution reads them
    kinematics: torch.Tensor  # [B,N,R,F+1] float32, scaled, the mask last; zeros in masked rows


def to_batch(histories: Sequence[History], device: str = "cpu") -> Batch:
    """Observations of AVs that decide together, as network inputs."""
    maps = np.stack([h.velocity_map for h in histories])
    kinematics = np.stack([h.kinematics for h in histories])
    valid = np.stack([h.valid for h in histories])
    return Batch(torch.from_numpy(maps).to(device), kinematic_tensor(kinematics, valid, device))


def situation_tensor(
    histories: Sequence[History], road: RoadMap, shared: bool, device: str = "cpu"
) -> torch.Tensor:
    """Their situation [B,SITUATION_INPUTS]: `policy.inputs.situation`."""
    return torch.from_numpy(situation(histories, road, shared)).to(device)


def svo_tensor(svo: float, agents: int, device: str = "cpu") -> torch.Tensor:
    """The social value orientation (rad) of all AVs as its cosine and sine [B,2]."""
    return torch.tensor([np.cos(svo), np.sin(svo)], dtype=torch.float32, device=device).expand(agents, 2)


def unit(maps: torch.Tensor) -> torch.Tensor:
    """Maps of any shape, uint8 pixels or float32 in [0,1] already -> float32 in [0,1]."""
    if maps.is_floating_point():
        return maps
    if maps.device.type != "cpu":
        return maps.to(torch.float32).mul_(1.0 / 255.0)
    return torch.from_numpy(np.multiply(maps.numpy(), _LEVEL, dtype=np.float32))  # in one pass over memory


def pixels(maps: torch.Tensor) -> torch.Tensor:
    """The inverse of `unit`, rounded, for recordings."""
    return (maps * 255.0 + 0.5).to(torch.uint8) if maps.is_floating_point() else maps


def kinematic_tensor(kinematics: Floats32 | Floats, valid: Bools, device: str = "cpu") -> torch.Tensor:
    """[...,R,F] m, m/s, rad and mask [...,R] -> scaled float32 [...,R,F+1]; masked or NaN rows become 0."""
    scaled = np.asarray(kinematics, np.float32) / KINEMATIC_SCALE
    mask = valid & np.isfinite(scaled).all(-1)
    out = np.concatenate([scaled, np.ones_like(scaled[..., :1])], -1)
    out = np.where(mask[..., None], out, np.float32(0.0))
    return torch.from_numpy(out).to(device)


def to_numpy(values: torch.Tensor) -> Floats32:
    """Any tensor -> float32 numpy on the host."""
    return np.asarray(values.detach().to("cpu", torch.float32).numpy(), np.float32)


def to_planes(maps: torch.Tensor) -> torch.Tensor:
    """Maps [B,4,H,W] of the channels PLANE_CHANNELS, as bytes -> [B,5,H,W]: occupancy and relative speed.

    A map's brightness encodes presence and speed at once, and 5 m/s change it little. Separate channels
    train faster: presence is 1 at any speed, and relative speed has its own channel.
    """
    if maps.device.type != "cpu":
        present = maps.clamp(max=1).to(torch.float32)
        speed = torch.from_numpy(_RELATIVE).to(maps.device)[torch.maximum(maps[:, 0], maps[:, 1]).long()]
        return torch.cat([present, speed[:, None]], 1)
    planes = np.empty((len(maps), *maps.shape[2:], PLANES), np.float32)
    _fill_planes(maps.numpy(), planes)
    return torch.from_numpy(planes).permute(0, 3, 1, 2)


@compiled
def _fill_planes(maps: Bytes, planes: Floats32) -> None:
    """Fills `planes` [B,H,W,PLANES], channels last as convolutions read them, in one pass over memory."""
    for b in range(planes.shape[0]):
        for y in range(planes.shape[1]):
            for x in range(planes.shape[2]):
                for c in range(PLANES - 1):
                    planes[b, y, x, c] = 1.0 if maps[b, c, y, x] else 0.0
                planes[b, y, x, 4] = _RELATIVE[max(maps[b, 0, y, x], maps[b, 1, y, x])]
