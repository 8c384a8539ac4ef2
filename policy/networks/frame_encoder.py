"""The frame encoder: one map in, a latent vector out, pretrained on quantities visible in a map."""

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from policy.inputs.tensors import PLANES


@dataclass(frozen=True, slots=True)
class EncoderConfig:
    """Layout of the encoder. Defaults: the compact map, 32 m across by 256 m along."""

    height: int = 32
    width: int = 128
    features: tuple[int, int, int] = (24, 32, 32)
    latent: int = 128  # length of a frame's latent vector


class FrameEncoder(nn.Module):
    """Three 2D convolutions and a layer: planes of `policy.inputs.tensors.to_planes` -> latents.

    The resolution is coarser along the road than across: lanes are 3 m apart, gaps tens of metres. A frame's
    map never changes, so its latent can be stored in its place.
    """

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = c = config
        first, second, third = c.features
        self.layers = nn.Sequential(
            nn.Conv2d(PLANES, first, (4, 8), (2, 4), (1, 2)),
            nn.ReLU(inplace=True),
            nn.Conv2d(first, second, 4, 2, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(second, third, 3, (2, 1), 1),
            nn.ReLU(inplace=True),
        )
        rows = (c.height // 4 + 1) // 2
        self.latent = nn.Linear(third * rows * (c.width // 8), c.latent)

    def forward(self, planes: torch.Tensor) -> torch.Tensor:
        """[n,APART,H,W] -> [n,latent]."""
        out: torch.Tensor = functional.relu(self.latent(self.layers(planes).flatten(1)))
        return out


class Sight(nn.Module):
    """The encoder with a linear readout for its pretraining.

    Args:
        config: layout of the encoder.
        readings: number of readout values.
    """

    def __init__(self, config: EncoderConfig, readings: int) -> None:
        super().__init__()
        self.encoder = FrameEncoder(config)
        self.read = nn.Sequential(nn.Linear(config.latent, config.latent), nn.ReLU())
        self.out = nn.Linear(config.latent, readings)

    def forward(self, planes: torch.Tensor) -> torch.Tensor:
        """[n,APART,H,W] -> [n,readings]."""
        out: torch.Tensor = self.out(self.read(self.encoder(planes)))
        return out
