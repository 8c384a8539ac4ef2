"""The HPN's map branch, P's figure 3 as written: past observations in, the next map and kinematics out."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn
from torch.nn import functional

from policy.inputs.tensors import KINEMATIC_INPUTS

Size = tuple[int, int]
PREDICTED = 4  # x, y, speed, heading of each row: P's K


@dataclass(frozen=True, slots=True)
class MapBranchConfig:
    """Layout of the network. Defaults: compact size; P gives no strides, so two readings are offered."""

    height: int = 32
    width: int = 128
    channels: int = 4
    frames: int = 10  # N, 2 s of history (P, Table I)
    rows: int = 16
    block: int = 5  # frames predicted per step; 1 is the paper's (observation.md, Clocks)
    reading: Literal["s2fc", "pool"] = "pool"  # stride 2 then FC, or stride 2 with pooling
    history: bool = True  # False: the current frame only (P, figure 6)
    correct: bool = False  # True: read the rendered next map and predict its correction
    skips: bool = False  # skip connections from encoder to decoder: P has none
    features: tuple[int, int, int] = (32, 64, 64)  # P, section IV-C.1
    hidden: int = 128  # P: FC layers of the K branch
    latent: int = 512  # P, Table I

    @property
    def seen(self) -> int:
        """Number of past frames in the input."""
        return self.frames if self.history else 1


class MapBranch(nn.Module):
    """Predictive autoencoder with a map branch and a kinematic branch, added elementwise.

    With `correct`, the last map layer starts at zero: the untrained network returns the rendered map, the
    baseline that training has to beat.
    """

    def __init__(self, config: MapBranchConfig) -> None:
        super().__init__()
        self.config = c = config
        size = (c.height, c.width)
        self._stages: list[tuple[Size, Size, Size]] = []  # input size, output size, pooling of each layer
        widths = [(c.seen + (c.block if c.correct else 0)) * c.channels, *c.features]
        self.encoder = nn.ModuleList()
        for k in range(3):
            self.encoder.append(nn.Conv2d(widths[k], widths[k + 1], 3, stride=2, padding=1))
            h, w = ((n + 1) // 2 for n in size)
            pool = (2 if h > 1 else 1, 2 if w > 1 else 1) if c.reading == "pool" else (1, 1)
            self._stages.append((size, (h, w), pool))
            size = (h // pool[0], w // pool[1])
        self._core = (c.features[2], *size)  # shape of the convolution output
        flat = self._core[0] * self._core[1] * self._core[2]
        self.kinematics_in = nn.Sequential(
            nn.Linear(c.seen * c.rows * KINEMATIC_INPUTS, c.hidden), nn.ReLU(), nn.Linear(c.hidden, flat)
        )
        direct = c.reading == "pool" and flat == c.latent  # the paper's sizes then need no extra layer
        self.to_latent = nn.Identity() if direct else nn.Linear(flat, c.latent)
        self.from_latent = nn.Identity() if direct else nn.Linear(c.latent, flat)
        self.decoder = nn.ModuleList()
        outs = [c.features[1], c.features[0], c.block * c.channels]
        for k, source in enumerate((c.features[2], *outs[:2])):
            self.decoder.append(nn.ConvTranspose2d(source, outs[k], 3, stride=2, padding=1))
        self.kinematics_out = nn.Sequential(
            nn.Linear(c.latent, c.hidden), nn.ReLU(), nn.Linear(c.hidden, c.block * c.rows * PREDICTED)
        )
        if c.correct:
            for parameter in self.decoder[2].parameters():
                nn.init.zeros_(parameter)

    def encode(self, z: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Frames [B,k*C,H,W] through the encoder: its output, and every layer's output before pooling."""
        layers: list[torch.Tensor] = []
        for convolution, (_, _, pool) in zip(self.encoder, self._stages, strict=True):
            z = functional.relu_(convolution(z))
            layers.append(z)
            if pool != (1, 1):
                z = functional.max_pool2d(z, pool)
        return z, layers

    def forward(
        self, past: torch.Tensor, kinematics: torch.Tensor, rendered: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """One prediction step (P, figure 3). Fastest in channels_last.

        Args:
            past: [B,seen*C,H,W] maps of the `seen` frames in [0,1], oldest first.
            kinematics: [B,seen,R,F+1] scaled.
            rendered: [B,block*C,H,W] with `correct`, of the frames to predict.

        Returns:
            the next maps [B,block*C,H,W] (not clamped) and kinematics [B,block,R,4] x, y, speed, heading
            (scaled as the input is).

        Raises:
            ValueError: a rendered map is missing, or is given without `correct`.
        """
        c = self.config
        if c.correct != (rendered is not None):
            raise ValueError("a rendered map is needed exactly when the network corrects one")
        b = kinematics.shape[0]
        z, skips = self.encode(past if rendered is None else torch.cat([past, rendered], 1))
        moved = self.kinematics_in(kinematics.flatten(1))
        latent = functional.relu(self.to_latent(z.flatten(1) + moved))  # P: elementwise addition
        z = functional.relu(self.from_latent(latent)).reshape(b, *self._core)
        z = z.contiguous(memory_format=torch.channels_last)
        for k, (convolution, (before, convolved, pool)) in enumerate(
            zip(self.decoder, reversed(self._stages), strict=True)
        ):
            if pool != (1, 1):  # undo the pooling
                z = functional.interpolate(z, size=convolved, mode="nearest")
            if c.skips:
                z = z + skips[2 - k]
            z = convolution(z, output_size=list(before))
            if k < 2:
                z = functional.relu_(z)
        if rendered is not None:
            z = z + rendered
        return z, self.kinematics_out(latent).reshape(b, c.block, c.rows, PREDICTED)
