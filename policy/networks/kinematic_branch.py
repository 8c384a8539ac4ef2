"""The HPN's kinematic branch: a correction of every vehicle's forecast, with a confidence per position.

P's branch K is two fully connected layers of 128 units; the Gaussian process corrects their output (P, figure
3, eq. 10). Here the branch corrects the Gaussian process, one vehicle at a time. Inputs are two forecasts:
the Gaussian process's, and the same speeds along the lane. Outputs are the weight of each forecast and the
offset ahead and aside. All vehicles share the weights; neighbours enter through pooled features of the
nearest. An untrained branch corrects nothing.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from cosim.types import Floats, Floats32, Ints
from policy.prediction.forecast import KinematicForecast
from policy.prediction.vehicle_inputs import NEIGHBOUR_INPUTS, VehicleInputs, own_inputs

OUTPUTS = 7  # weight of the GP; ahead, left, speed, heading; confidence as seen vehicle, as observing AV


@dataclass(frozen=True, slots=True)
class KinematicConfig:
    """Layout of the branch."""

    frames: int = 10  # N, P: 2 s of history
    horizon: int = 20  # frames ahead, P: 4 s
    history: bool = True  # False: the current frame only (P, figure 6)
    hidden: int = 128  # P: FC layers of the K branch
    neighbour: int = 64  # features of one neighbour


class KinematicBranch(nn.Module):
    """See the module's docstring."""

    unit: torch.Tensor

    def __init__(self, config: KinematicConfig) -> None:
        super().__init__()
        self.config = c = config
        inputs = own_inputs(c.frames)
        self.own = nn.Sequential(
            nn.Linear(inputs, c.hidden), nn.ReLU(), nn.Linear(c.hidden, c.hidden), nn.ReLU()
        )
        self.near = nn.Sequential(
            nn.Linear(NEIGHBOUR_INPUTS, c.neighbour),
            nn.ReLU(),
            nn.Linear(c.neighbour, c.neighbour),
            nn.ReLU(),
        )
        self.joined = nn.Sequential(
            nn.Linear(c.hidden + 2 * c.neighbour, c.hidden),
            nn.ReLU(),
            nn.Linear(c.hidden, c.hidden),
            nn.ReLU(),
        )
        self.out = nn.Linear(c.hidden, c.horizon * OUTPUTS)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        t = torch.linspace(0.0, 1.0, c.horizon + 1)[1:]  # share of the horizon
        one = torch.ones_like(t)
        # scale of the error at each frame, so that every output is of order one
        scale = [2 * one, 4 * t**2 + 0.005, t**1.5 + 0.002, 4 * t + 0.02, 0.3 * t**1.5 + 0.001, one, one]
        self.register_buffer("unit", torch.stack(scale, -1), persistent=False)

    def features(self, own: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
        """The last hidden layer [V,hidden]; arguments as in `forward`."""
        n = self.near(near) * near[..., :1]  # the first input is 1 for an existing neighbour
        joined: torch.Tensor = self.joined(torch.cat([self.own(own), n.amax(-2), n.mean(-2)], -1))
        return joined

    def forward(self, own: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
        """The correction of every vehicle's forecast (P, figure 3 and eq. 10).

        Args:
            own: [V,own_inputs(N)] scaled (`policy.prediction.vehicle_inputs.VehicleInputs`).
            near: [V,NEIGHBOURS,NEIGHBOUR_INPUTS] scaled.

        Returns:
            [V,M,OUTPUTS] weight of the Gaussian process (logit); ahead m, left m, speed m/s, heading rad;
            two logits of `confidence`.
        """
        raw: torch.Tensor = self.out(self.features(own, near)).contiguous()
        return raw.view(*raw.shape[:-1], self.config.horizon, OUTPUTS) * self.unit


def correct(raw: torch.Tensor, lane: torch.Tensor, gp: torch.Tensor) -> torch.Tensor:
    """Corrected states [...,M,4] x y speed heading from raw [...,M,OUTPUTS] and the two forecasts [...,M,4].

    Untrained, the forecast along the lane has seven times the weight of the Gaussian process's.
    """
    base = lane + torch.sigmoid(raw[..., :1] - 2.0) * (gp - lane)
    c, s = torch.cos(base[..., 3]), torch.sin(base[..., 3])
    return torch.stack(
        [
            base[..., 0] + c * raw[..., 1] - s * raw[..., 2],
            base[..., 1] + s * raw[..., 1] + c * raw[..., 2],
            (base[..., 2] + raw[..., 3]).clamp_min(0.0),
            base[..., 3] + raw[..., 4],
        ],
        -1,
    )


def confidence(seen: torch.Tensor, looking: torch.Tensor) -> torch.Tensor:
    """Expected overlap of a vehicle's drawn box with its true box, in the picture of an observing AV.

    Logits of the seen vehicle and of the observing AV (its own pose has an error too) -> [0,1].
    """
    return torch.sigmoid(seen + looking + 4.0)


class Corrected(NamedTuple):
    """A scene's corrected forecast."""

    forecast: KinematicForecast
    seen: Floats32  # [V,M] logits of `confidence`
    looking: Floats32  # [V,M]

    def share(self, index: Ints) -> Floats:
        """[B,k,M] `confidence` of the vehicles `index` [B,k] in each AV's picture, the AV itself first."""
        logit = self.seen[index] + self.looking[index[:, 0]][:, None] + 4.0
        out: Floats = 1.0 / (1.0 + np.exp(-logit.astype(np.float64)))
        out[:, 0] = 1.0  # an AV is at the centre of its own picture by definition
        return out


def apply(branch: KinematicBranch, inputs: VehicleInputs, forecast: KinematicForecast) -> Corrected:
    """Correct a scene's forecast (at least `horizon` frames; later frames are cut)."""
    m = branch.config.horizon
    lane, gp = inputs.lane[:, :m], inputs.gp[:, :m]
    origin = lane[:, :1] * (1.0, 1.0, 0.0, 0.0)  # world coordinates exceed the precision of float32
    device = branch.unit.device
    with torch.autocast(device.type, enabled=False):
        raw = branch(torch.from_numpy(inputs.own).to(device), torch.from_numpy(inputs.near).to(device))
        near = [torch.from_numpy((a - origin).astype(np.float32)).to(device) for a in (lane, gp)]
        moved = correct(raw, near[0], near[1]).cpu().numpy().astype(np.float64) + origin
    moved = np.where(inputs.known[:, None, None], moved, 0.0)
    surely = raw[..., 5:].cpu().numpy()
    f = forecast
    corrected = KinematicForecast(
        moved[..., 0],
        moved[..., 1],
        moved[..., 2],
        moved[..., 3],
        f.speed_std[:, :m],
        f.heading_std[:, :m],
        f.along_std[:, :m],
        f.across_std[:, :m],
        inputs.known,
    )
    return Corrected(corrected, surely[..., 0], surely[..., 1])
