"""P's learned baselines: LSTM and autoencoder, each direct (positions) and indirect (speed and heading)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import nn

from cosim.errors import BadInput
from cosim.types import Bools, Floats
from policy.checkpoint import SHIPPED, load
from policy.prediction.forecast import KinematicForecast, motion_of
from policy.prediction.past import trailing_run, whole_past

INPUTS = 6  # per frame, see `features`
# Scales that bring inputs and outputs to order one: m behind, m aside, m/s, rad, m/s of change.
BEHIND_SCALE, ASIDE_SCALE, SPEED_SCALE, HEADING_SCALE, SPEED_GAIN_SCALE = 30.0, 5.0, 15.0, 0.3, 2.0


@dataclass(frozen=True, slots=True)
class NetConfig:
    """Layout of one network; small, like P's baselines."""

    kind: Literal["lstm", "ae"]
    target: Literal["direct", "indirect"]
    frames: int = 10  # N
    horizon: int = 20  # M
    dt: float = 0.2  # s
    hidden: int = 64
    latent: int = 16  # size, of the autoencoder


class KinematicNet(nn.Module):
    """Features of the past -> the next M frames in the vehicle's own frame (x ahead, y left, heading 0 now).

    `lstm`: one layer, its last state decoded by two dense layers. `ae`: dense encoder of the whole past to
    `latent` numbers, mirrored decoder to the future.
    """

    def __init__(self, config: NetConfig) -> None:
        super().__init__()
        self.config = c = config
        outputs = 2 * c.horizon
        if c.kind == "lstm":
            self.lstm = nn.LSTM(INPUTS, c.hidden, batch_first=True)
            self.head = nn.Sequential(nn.Linear(c.hidden, c.hidden), nn.ReLU(), nn.Linear(c.hidden, outputs))
        else:
            self.head = nn.Sequential(
                nn.Flatten(),
                nn.Linear(INPUTS * c.frames, c.hidden),
                nn.ReLU(),
                nn.Linear(c.hidden, c.latent),
                nn.ReLU(),
                nn.Linear(c.latent, c.hidden),
                nn.ReLU(),
                nn.Linear(c.hidden, outputs),
            )

    def forward(self, past: torch.Tensor, speed: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The next M frames of V vehicles.

        Args:
            past: [V,N,INPUTS] (`features`).
            speed: [V] m/s, now.

        Returns:
            x, y [V,M] m in the own frame; an indirect network also speed [V,M] m/s, heading [V,M] rad.
        """
        c = self.config
        if c.kind == "lstm":
            past = self.lstm(past)[0][:, -1]
        raw = self.head(past).view(-1, 2, c.horizon)
        elapsed = c.dt * torch.arange(1, c.horizon + 1, dtype=raw.dtype)
        if c.target == "direct":
            return speed[:, None] * elapsed + ASIDE_SCALE * raw[:, 0], SPEED_GAIN_SCALE * raw[:, 1]
        v = (speed[:, None] + SPEED_GAIN_SCALE * raw[:, 0]).clamp(min=0.0)
        h = HEADING_SCALE * raw[:, 1]
        return *integrate(speed, v, h, c.dt), v, h


def integrate(
    now: torch.Tensor, speed: torch.Tensor, heading: torch.Tensor, dt: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """P, eq. (9), trapezoid rule in the vehicle's own frame: now [V] m/s, speed, heading [V,M] -> x, y."""
    v = torch.cat([now[:, None], speed], 1)
    h = torch.cat([torch.zeros_like(heading[:, :1]), heading], 1)
    vx, vy = v * torch.cos(h), v * torch.sin(h)
    return (
        torch.cumsum(0.5 * dt * (vx[:, 1:] + vx[:, :-1]), 1),
        torch.cumsum(0.5 * dt * (vy[:, 1:] + vy[:, :-1]), 1),
    )


def features(past: Floats, known: Bools) -> torch.Tensor:
    """[V,N,INPUTS] of whole pasts [V,N,>=4], known [V]: place, speed, heading, gain in speed since."""
    now = past[:, -1:]
    dx, dy = past[:, :, 0] - now[:, :, 0], past[:, :, 1] - now[:, :, 1]
    c, s = np.cos(now[:, :, 3]), np.sin(now[:, :, 3])
    columns = (
        (c * dx + s * dy) / BEHIND_SCALE,
        (c * dy - s * dx) / ASIDE_SCALE,
        past[:, :, 2] / SPEED_SCALE,
        (past[:, :, 3] - now[:, :, 3]) / HEADING_SCALE,
        (past[:, :, 2] - now[:, :, 2]) / SPEED_GAIN_SCALE,
        np.ones_like(dx),
    )
    return torch.from_numpy(np.where(known[:, None, None], np.stack(columns, -1), 0.0).astype(np.float32))


class Learned:
    """One of the four networks as a `Predictor`. `weights`: None for the shipped ones.

    Raises BadInput for another horizon or dt than in training, WeightsMismatch for weights of another layout.
    """

    def __init__(
        self,
        config: NetConfig,
        horizon: int = 20,
        dt: float = 0.2,
        weights: Path | KinematicNet | None = None,
    ) -> None:
        self.name = f"{config.kind}-{config.target}"
        self.horizon, self.dt = horizon, dt
        if horizon > config.horizon or abs(dt - config.dt) > 1e-9:
            raise BadInput(
                f"predicts {config.horizon} frames of {config.dt:g} s, not {horizon} of {dt:g} s",
                field="predictor",
                value=self.name,
            )
        if isinstance(weights, KinematicNet):
            self.network = weights.eval()
        else:
            self.network = KinematicNet(config).eval()
            file = weights or SHIPPED / f"{self.name}.safetensors"
            load(file, {"network": self.network}, {"network": config})

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """See `Predictor.predict`; no intervals. Short histories are completed (`policy.prediction.past`)."""
        state = np.asarray(kinematics[:, :, :4], dtype=np.float64)
        run = trailing_run(state, valid)
        known = run > 0
        past = whole_past(state, run, self.network.config.frames, self.dt)
        now, m = past[:, -1], self.horizon
        seen = features(past, known)
        with torch.inference_mode():
            speed_now = torch.from_numpy(now[:, 2].astype(np.float32))
            u, w, *rest = (t[:, :m].to(torch.float64).numpy() for t in self.network(seen, speed_now))
        c, s = np.cos(now[:, 3:4]), np.sin(now[:, 3:4])
        x, y = now[:, :1] + c * u - s * w, now[:, 1:2] + s * u + c * w
        speed, heading = (rest[0], now[:, 3:4] + rest[1]) if rest else motion_of(now, x, y, self.dt)
        x, y, speed, heading = (np.where(known[:, None], a, 0.0) for a in (x, y, speed, heading))
        return KinematicForecast.without_spread(x, y, speed, heading, known)
