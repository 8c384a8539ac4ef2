"""The HPN's kinematic branch: corrects every vehicle's forecast, and says how sure it is of each place.

P's branch K is two fully connected layers of 128 whose output the Gaussian process corrects (P, figure 3,
eq. 10). Here it works the other way round, and for one vehicle at a time: the forecasts (Gaussian process,
and the same speeds along the lane) come in, a small correction goes out: how much of each forecast to
believe, how far ahead or aside of it the vehicle will really be. The weights are shared by all vehicles,
which see one another through pooled features of the nearest. Untrained it corrects nothing.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from cosim.types import Floats, Floats32, Ints
from policy.prediction.forecast import KinematicForecast
from policy.prediction.vehicle_inputs import NEIGHBOUR_INPUTS, VehicleInputs, own_inputs

OUTPUTS = 7  # belief in the GP; ahead, left, speed, heading; sureness as the one seen, as the one who looks


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
        t = torch.linspace(0.0, 1.0, c.horizon + 1)[1:]  # of the horizon
        one = torch.ones_like(t)
        # how large an error is at each frame, so that every output is of order one
        scale = [2 * one, 4 * t**2 + 0.005, t**1.5 + 0.002, 4 * t + 0.02, 0.3 * t**1.5 + 0.001, one, one]
        self.register_buffer("unit", torch.stack(scale, -1), persistent=False)

    def features(self, own: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
        """The last hidden layer [V,hidden]; arguments as in `forward`."""
        n = self.near(near) * near[..., :1]  # the first input says whether anybody is there
        joined: torch.Tensor = self.joined(torch.cat([self.own(own), n.amax(-2), n.mean(-2)], -1))
        return joined

    def forward(self, own: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
        """What to correct of every vehicle's forecast (P, figure 3 and eq. 10).

        Args:
            own: [V,own_inputs(N)] scaled (`policy.prediction.vehicle_inputs.VehicleInputs`).
            near: [V,NEIGHBOURS,NEIGHBOUR_INPUTS] scaled.

        Returns:
            [V,M,OUTPUTS] belief in the Gaussian process (logit); ahead m, left m, speed m/s, heading rad; two
            logits of `sureness`.
        """
        raw: torch.Tensor = self.out(self.features(own, near)).contiguous()
        return raw.view(*raw.shape[:-1], self.config.horizon, OUTPUTS) * self.unit


def correct(raw: torch.Tensor, lane: torch.Tensor, gp: torch.Tensor) -> torch.Tensor:
    """Corrected states [...,M,4] x y speed heading from raw [...,M,OUTPUTS] and the two forecasts [...,M,4].

    Untrained the lane's forecast is believed seven times as much as the Gaussian process's.
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


def sureness(seen: torch.Tensor, looking: torch.Tensor) -> torch.Tensor:
    """Expected share of a vehicle's drawn box that is really its own, in the picture of one who looks.

    Logits of the vehicle seen and of the AV that looks (its own pose errs as well) -> [0,1].
    """
    return torch.sigmoid(seen + looking + 4.0)


class Corrected(NamedTuple):
    """What the branch makes of a scene's forecast."""

    forecast: KinematicForecast
    seen: Floats32  # [V,M] logits of `sureness`
    looking: Floats32  # [V,M]

    def share(self, who: Ints) -> Floats:
        """[B,k,M] `sureness` of the vehicles who [B,k] in the picture of each AV, the AV itself first."""
        logit = self.seen[who] + self.looking[who[:, 0]][:, None] + 4.0
        out: Floats = 1.0 / (1.0 + np.exp(-logit.astype(np.float64)))
        out[:, 0] = 1.0  # every AV is in the middle of its own picture
        return out


def apply(branch: KinematicBranch, inputs: VehicleInputs, forecast: KinematicForecast) -> Corrected:
    """Correct a scene's forecast (at least `horizon` frames; the frames beyond it are cut)."""
    m = branch.config.horizon
    lane, gp = inputs.lane[:, :m], inputs.gp[:, :m]
    origin = lane[:, :1] * (1.0, 1.0, 0.0, 0.0)  # world coordinates need more digits than float32 has
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
