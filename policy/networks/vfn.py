"""The value function network: action values from past and predicted maps, kinematics, situation and phi.

A 3D CNN after T's Table 1 (Conv3D 32@(1,8,8), 64@(3,4,4), 64@(3,3,3), FC 512, FC 256, FC 5); kinematics
and the ego's situation join after FC 512 through MLPs. The baselines of Table III are the same network with
parts left out.
"""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import nn
from torch.nn import functional

from cosim.types import IS_MISSION, MetaAction
from policy.inputs.situation import SITUATION_INPUTS
from policy.inputs.tensors import KINEMATIC_INPUTS, PLANES, to_planes, unit
from policy.networks.extractors import Conv2dMaps, Conv3dMaps, EncodedMaps, FrameMemory, Strides
from policy.networks.frame_encoder import EncoderConfig


@dataclass(frozen=True, slots=True)
class Layout:
    """Options of the network in a training configuration. Defaults: half of T's widths and a third of the
    arithmetic, for training on two cores. `TABLE_1` is T's."""

    # the last two: all frames, or the newest one alone, each through a frozen `FrameEncoder`
    extractor: Literal["conv3d", "conv2d", "frames", "frame"] = "conv3d"
    strides: Strides = "temporal"
    features: tuple[int, int, int] = (16, 32, 32)  # T, Table 1: 32, 64, 64
    hidden: int = 256  # T, Table 1: 512
    joined: int = 256  # T, Table 1
    dueling: bool = True  # q = state value + advantage: differences between actions are small
    parts: int = 1  # 2: separate values for the ego's and the others' part of the reward

    @property
    def encoded(self) -> bool:
        """Whether a frozen, pretrained encoder reads the maps."""
        return self.extractor in ("frames", "frame")


@dataclass(frozen=True, slots=True)
class VfnConfig(Layout):
    """The whole layout: the inputs follow from the approach and the observation (`policy.agents.approaches`).
    Defaults: compact maps, 10 past and 4 predicted frames."""

    height: int = 32
    width: int = 128
    channels: int = 4
    frames: int = 14  # N, or N + M with predicted maps
    rows: int = 16
    kinematic: int = 64  # features of a vehicle; 0: maps (through `to_planes`) and phi are the only inputs
    situation: int = 64  # width of the situation branch; used with `kinematic`
    latent: int = 128  # length of a frame's latent vector (with an encoder)
    critic: bool = False  # True: action preferences and a state value (A2C), not action values


TABLE_1 = VfnConfig(features=(32, 64, 64), hidden=512, strides="literal", dueling=False)


class VehicleBranch(nn.Module):
    """Kinematics [B,T,R,F+1] -> [B,3*width]: the ego, the others' strongest features, mission vehicles.

    Every vehicle passes through the same two layers, so the order of rows does not matter. The mission
    vehicle's last frame is an input of every row: the AV that should yield depends on the vehicles between
    the two.
    """

    def __init__(self, frames: int, width: int) -> None:
        super().__init__()
        inputs = (frames + 1) * KINEMATIC_INPUTS
        self.one = nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())

    def forward(self, kinematics: torch.Tensor) -> torch.Tensor:
        """Features [B,3*width]; rows without a vehicle contribute zeros."""
        mission, seen = kinematics[..., IS_MISSION].amax(1), kinematics[..., -1].amax(1)  # [B,R]
        served = (kinematics[:, -1] * mission[..., None]).sum(1, keepdim=True)  # [B,1,F+1]
        rows = [kinematics.transpose(1, 2).flatten(2), served.expand(-1, kinematics.shape[2], -1)]
        each = self.one(torch.cat(rows, 2)) * seen[..., None]  # [B,R,width]
        return torch.cat([each[:, 0], each[:, 1:].amax(1), (each * mission[..., None]).sum(1)], 1)


class Frames(NamedTuple):
    """In place of maps: the first layer's features of each frame (`VFN.memory`)."""

    features: torch.Tensor  # [B,T,F,h,w]


class VFN(nn.Module):
    """Q(s, .; w) for the five meta-actions (with `critic`: log-preferences and V(s; w)).

    The last layers start at zero: an untrained network gives every action the same value.
    """

    def __init__(self, config: VfnConfig) -> None:
        super().__init__()
        self.config = c = config
        # without kinematics the network must extract them from pixels
        channels, read = (c.channels, unit) if c.kinematic else (PLANES, to_planes)
        shape = c.frames, channels, c.height, c.width
        if c.encoded:
            count = c.frames if c.extractor == "frames" else 1
            self.maps: Any = EncodedMaps(count, EncoderConfig(c.height, c.width, latent=c.latent))
        elif c.extractor == "conv2d":
            self.maps = Conv2dMaps(*shape, c.features, read)
        else:
            self.maps = Conv3dMaps(*shape, c.features, c.strides, read)
        self.hidden = nn.Linear(int(self.maps.flat), c.hidden)
        self.kinematics = VehicleBranch(c.frames, c.kinematic) if c.kinematic else None
        own = c.situation if c.kinematic else 0
        if own:
            # a separate branch, so that few situation inputs are not dominated by many map features
            self.situation = nn.Sequential(
                nn.Linear(SITUATION_INPUTS, c.situation),
                nn.ReLU(),
                nn.Linear(c.situation, c.situation),
                nn.ReLU(),
            )
        self.joined = nn.Linear(c.hidden + 3 * c.kinematic + own + 2, c.joined)
        self.value = nn.Linear(c.joined, len(MetaAction) * c.parts)
        self.state = nn.Linear(c.joined, c.parts) if c.critic or c.dueling else None
        for head in (self.value, self.state) if self.state is not None else (self.value,):
            for parameter in head.parameters():
                nn.init.zeros_(parameter)

    @property
    def layout(self) -> torch.memory_format:
        """The memory format of the fastest convolutions."""
        return torch.channels_last_3d if self.config.extractor == "conv3d" else torch.channels_last

    def memory(self, past: int, fresh: int) -> FrameMemory | None:
        """A cache of `Frames` for one episode; `fresh` of the `past` maps are new at each decision."""
        return None if isinstance(self.maps, Conv2dMaps) else FrameMemory(self.maps, past, fresh)

    def features(
        self,
        maps: torch.Tensor | Frames | None,
        kinematics: torch.Tensor,
        situation: torch.Tensor,
        phi: torch.Tensor,
    ) -> torch.Tensor:
        """The joined representation [B,joined]; arguments as in `forward`."""
        if maps is None:
            parts = [phi.new_zeros(len(phi), self.config.hidden)]
        else:
            flat = self.maps.stacked(maps.features) if isinstance(maps, Frames) else self.maps(maps)
            parts = [functional.relu(self.hidden(flat))]
        if self.kinematics is not None:
            parts += [self.kinematics(kinematics), self.situation(situation)]
        return functional.relu(self.joined(torch.cat([*parts, phi], 1)))

    def forward(
        self,
        maps: torch.Tensor | Frames | None,
        kinematics: torch.Tensor,
        situation: torch.Tensor,
        phi: torch.Tensor,
    ) -> torch.Tensor:
        """Action values (P, figure 4).

        Args:
            maps: [B,T,C,H,W] uint8 pixels (with kinematics also float32 in [0,1]), past frames first; or
                their `Frames`; or with an encoder their latents [B,T,L]; None: the map branch returns
                zeros without convolutions.
            kinematics: [B,T,R,F+1] scaled, the mask last (`policy.inputs.tensors.kinematic_tensor`).
            situation: [B,SITUATION_INPUTS] (`policy.inputs.situation.situation`).
            phi: [B,2] cosine and sine of the SVO (`policy.inputs.tensors.svo_tensor`).

        Returns:
            q: [B,5] value of each `MetaAction`.
        """
        return self.weighed(self.part_values(maps, kinematics, situation, phi), phi)

    def part_values(
        self,
        maps: torch.Tensor | Frames | None,
        kinematics: torch.Tensor,
        situation: torch.Tensor,
        phi: torch.Tensor,
    ) -> torch.Tensor:
        """Values [B,parts,5] of the reward's parts weighted with cos and sin of phi (P, equation 6; with one
        part: of the whole reward), for an AV that acts with that phi. Arguments as in `forward`."""
        z = self.features(maps, kinematics, situation, phi)
        q: torch.Tensor = self.value(z).view(len(z), self.config.parts, len(MetaAction))
        if self.config.dueling and self.state is not None:
            q = q - q.mean(2, keepdim=True) + self.state(z)[..., None]
        return q

    def weighed(self, parts: torch.Tensor, phi: torch.Tensor) -> torch.Tensor:
        """Action values [B,5] from their parts [B,parts,5]; phi [B,2]."""
        return parts[:, 0] if self.config.parts == 1 else (parts * phi[..., None]).sum(1)

    def actor_critic(
        self,
        maps: torch.Tensor | Frames | None,
        kinematics: torch.Tensor,
        situation: torch.Tensor,
        phi: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-preferences [B,5] (not normalised) and state values [B] (T, figure 4).

        Arguments as in `forward`. Raises ValueError when the network has no critic (`VfnConfig.critic`).
        """
        if self.state is None or not self.config.critic:
            raise ValueError("this network has no critic")
        z = self.features(maps, kinematics, situation, phi)
        return self.value(z), self.state(z)[:, 0]
