"""The learned prior over a bank's kernels, given a vehicle's present motion.

A network with one small hidden layer maps features of the present motion to a log weight per kernel and a
factor on each standard deviation; the temperature of the marginal likelihood is learned too. Fitted on
recorded training episodes (`policy.training.predictors`), shipped in `policy/weights`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from cosim.geometry.compiled import compiled
from cosim.types import Bools, Floats

LAGS = np.array([1, 2, 4, 9])  # frames back over which speed and heading are compared with now
FEATURES = 4 + 2 * len(LAGS) + 3
STANDSTILL_SPEED = 0.1  # m/s, SUMO's own threshold of a halt


@dataclass(frozen=True, slots=True)
class PriorConfig:
    """Layout of one prior; a checkpoint of another layout is refused."""

    kernels: tuple[int, ...]  # of each bank
    spreads: int  # number of scaled standard deviations
    horizon: int = 20
    frames: int = 10  # N, a complete history
    dt: float = 0.2  # s
    features: int = FEATURES
    hidden: int = 64


class PriorNetwork(nn.Module):
    """The prior as a torch module, for training and storage. Starts as the uniform prior."""

    calibration: torch.Tensor

    def __init__(self, config: PriorConfig) -> None:
        super().__init__()
        self.config = config
        self.hidden = nn.Linear(config.features, config.hidden)
        self.out = nn.Linear(config.hidden, sum(config.kernels) + config.spreads)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.log_temperature = nn.Parameter(torch.full((len(config.kernels),), 2.5))
        # factors that make a 90 % interval cover 90 % at each step, from held-out episodes; a row for each
        # number of known frames, 1 to N: a completed past is less certain
        self.register_buffer("calibration", torch.ones(config.frames, config.spreads, config.horizon))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[V,F] -> [V,sum(kernels)+spreads]: log weights of every bank's kernels, log factors."""
        return torch.as_tensor(self.out(torch.tanh(self.hidden(features))))


class KernelPrior(NamedTuple):
    """The prior in numpy, for prediction."""

    hidden: tuple[Floats, Floats]  # [F,H], [H]
    out: tuple[Floats, Floats]  # [H,K], [K]
    cuts: tuple[int, ...]  # end of each bank's weights
    temperature: Floats  # [banks]
    calibration: Floats  # [N,spreads,M]
    dt: float  # s between the calibration's steps

    @staticmethod
    def of(network: PriorNetwork) -> KernelPrior:
        values = {k: v.detach().to(torch.float64).numpy() for k, v in network.state_dict().items()}
        return KernelPrior(
            (values["hidden.weight"].T, values["hidden.bias"]),
            (values["out.weight"].T, values["out.bias"]),
            tuple(np.cumsum(network.config.kernels).tolist()),
            np.exp(values["log_temperature"]),
            values["calibration"],
            network.config.dt,
        )

    def apply(self, features: Floats) -> tuple[list[Floats], Floats]:
        """[V,F] -> log prior [V,K] of each bank, factors of the standard deviations [V,spreads]."""
        raw = np.tanh(features @ self.hidden[0] + self.hidden[1]) @ self.out[0] + self.out[1]
        parts = np.split(raw, self.cuts, axis=1)
        return parts[:-1], np.exp(parts[-1])

    def calibrated(self, horizon: int, dt: float) -> Floats:
        """[N,spreads,M] factors at the requested steps; beyond the last calibrated step, the last factor."""
        found = self.calibration
        known = self.dt * np.arange(1, found.shape[2] + 1)
        wanted = dt * np.arange(1, horizon + 1)
        rows = [np.interp(wanted, known, row) for row in found.reshape(-1, found.shape[2])]
        return np.stack(rows).reshape(*found.shape[:2], horizon)


@compiled
def describe(past: Floats, known: Bools, dt: float) -> Floats:
    """The present motion: speed, standing, mean acceleration and turning rate since LAGS, each of order one.

    Args:
        past: [V,N,>=4] whole histories: x m, y m, speed m/s, heading rad.
        known: [V] perceived in the newest frame; the others' features are zeros.
        dt: s between frames.

    Returns:
        [V,FEATURES].
    """
    out = np.zeros((len(past), FEATURES))
    now = past.shape[1] - 1
    for v in range(past.shape[0]):
        if not known[v]:
            continue
        speed, heading = past[v, now, 2], past[v, now, 3]
        out[v, 0] = speed / 15.0 - 1.0
        out[v, 1] = out[v, 0] ** 2
        out[v, 2] = speed < STANDSTILL_SPEED
        out[v, 3] = np.exp(-speed / 2.0)
        at = 4
        for frames in LAGS:
            lag = min(frames, now)
            elapsed = dt * max(lag, 1)
            out[v, at] = np.tanh((speed - past[v, now - lag, 2]) / elapsed / 2.0)
            out[v, at + 1] = np.tanh((heading - past[v, now - lag, 3]) / elapsed / 0.2)
            at += 2
        out[v, at] = abs(out[v, 4])
        out[v, at + 1] = abs(out[v, 5])
        out[v, at + 2] = abs(out[v, at - 1])
    return out
