"""The value function network: action values from past and predicted maps, kinematics, route and phi.

A 3D CNN after T's Table 1 (Conv3D 32@(1,8,8), 64@(3,4,4), 64@(3,3,3), FC 512, FC 256, FC 5); kinematics
and the ego's own route knowledge join after FC 512 through an MLP.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn
from torch.nn import functional

from cosim.types import MetaAction
from policy.tensors import KINEMATIC_INPUTS, ROUTE_INPUTS

# T gives no strides: two readings (compute.md, VFN). `literal` has no padding, `temporal` halves time too.
STRIDES = {
    "literal": ((1, 4, 4), (1, 2, 2), (1, 1, 1)),
    "temporal": ((1, 4, 4), (2, 2, 2), (2, 2, 2)),
}
KERNELS = ((1, 8, 8), (3, 4, 4), (3, 3, 3))  # T, Table 1


@dataclass(frozen=True, slots=True)
class VfnConfig:
    """Layout of the network. Defaults: compact size with 10 past and 4 predicted frames."""

    height: int = 32
    width: int = 128
    channels: int = 4
    frames: int = 14  # N, or N + M with predicted maps
    rows: int = 16
    strides: Literal["literal", "temporal"] = "temporal"
    features: tuple[int, int, int] = (32, 64, 64)  # T, Table 1
    hidden: int = 512  # T, Table 1
    joined: int = 256  # T, Table 1
    kinematic: int = 128  # as the HPN's K branch


class VFN(nn.Module):
    """Q(s, .; w) for the five meta-actions.

    The last layer starts at zero: an untrained network values every action alike.
    """

    def __init__(self, config: VfnConfig) -> None:
        super().__init__()
        self.config = c = config
        shape = (c.frames, c.height, c.width)
        widths = (c.channels, *c.features)
        layers: list[nn.Conv3d] = []
        for k, (stride, wanted) in enumerate(zip(STRIDES[c.strides], KERNELS, strict=True)):
            if c.strides == "temporal":
                padding = tuple((n - 1) // 2 for n in wanted)
                # a kernel never reaches beyond its (padded) input at the smaller sizes
                kernel = tuple(min(n, s + 2 * p) for n, s, p in zip(wanted, shape, padding, strict=True))
            else:
                padding = (0, 0, 0)
                kernel = tuple(min(n, s) for n, s in zip(wanted, shape, strict=True))
            layers.append(nn.Conv3d(widths[k], widths[k + 1], kernel, stride, padding))  # type: ignore[arg-type]
            shape = tuple(  # type: ignore[assignment]
                (s + 2 * p - n) // d + 1 for s, p, n, d in zip(shape, padding, kernel, stride, strict=True)
            )
        self.per_frame, self.second, self.third = layers
        self.flat = c.features[2] * shape[0] * shape[1] * shape[2]
        self.hidden = nn.Linear(self.flat, c.hidden)
        self.kinematics = nn.Sequential(
            nn.Linear(c.frames * c.rows * KINEMATIC_INPUTS + ROUTE_INPUTS, c.kinematic),
            nn.ReLU(),
            nn.Linear(c.kinematic, c.kinematic),
            nn.ReLU(),
        )
        self.joined = nn.Linear(c.hidden + c.kinematic + 2, c.joined)
        self.value = nn.Linear(c.joined, len(MetaAction))
        nn.init.zeros_(self.value.weight)
        nn.init.zeros_(self.value.bias)

    def features(
        self, maps: torch.Tensor, kinematics: torch.Tensor, route: torch.Tensor, phi: torch.Tensor
    ) -> torch.Tensor:
        """The joined representation [B,joined]; arguments as in `forward`."""
        b, t = maps.shape[:2]
        # a (1,8,8) kernel is a 2D convolution of every frame: no need to turn the maps around first
        first = self.per_frame
        z = functional.conv2d(
            maps.flatten(0, 1), first.weight[:, :, 0], first.bias, first.stride[1:], first.padding[1:]
        )
        z = functional.relu_(z).view(b, t, *z.shape[1:]).transpose(1, 2)  # [B,32,T,h,w]
        z = z.contiguous(memory_format=torch.channels_last_3d)
        z = functional.relu_(self.second(z))
        z = functional.relu_(self.third(z))
        z = functional.relu(self.hidden(z.flatten(1)))
        moved = self.kinematics(torch.cat([kinematics.flatten(1), route], 1))
        return functional.relu(self.joined(torch.cat([z, moved, phi], 1)))

    def forward(
        self, maps: torch.Tensor, kinematics: torch.Tensor, route: torch.Tensor, phi: torch.Tensor
    ) -> torch.Tensor:
        """maps [B,T,C,H,W] in [0,1], kinematics [B,T,R,F+1], route [B,.], phi [B,2] -> q [B,5]."""
        q: torch.Tensor = self.value(self.features(maps, kinematics, route, phi))
        return q
