"""The learned prior over a bank's kernels: which are likely for a vehicle that moves as this one does now.

A network of one small hidden layer from a few figures of the present motion to a log weight per kernel, the
temperature of the marginal likelihood, and how far the forecast can be trusted (a factor on each standard
deviation). Fitted on recorded training episodes (`policy.training.predictors`), shipped in `policy/weights`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from cosim.compiled import compiled
from cosim.types import Bools, Floats, Ints

FEATURES = 11
STANDING = 0.1  # m/s, SUMO's own threshold of a halt


@dataclass(frozen=True, slots=True)
class PriorConfig:
    """Layout of one prior; a checkpoint made for another one is refused."""

    kernels: tuple[int, ...]  # of each bank
    spreads: int  # quantities whose standard deviation is scaled
    horizon: int = 20
    dt: float = 0.2  # s
    features: int = FEATURES
    hidden: int = 32


class PriorNetwork(nn.Module):
    """As it is trained and stored. Starts as the uniform prior."""

    calibration: torch.Tensor

    def __init__(self, config: PriorConfig) -> None:
        super().__init__()
        self.config = config
        self.hidden = nn.Linear(config.features, config.hidden)
        self.out = nn.Linear(config.hidden, sum(config.kernels) + config.spreads)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.log_temperature = nn.Parameter(torch.full((len(config.kernels),), 2.5))
        # factors that make a 90 % interval cover 90 % at each step, found on episodes not trained on
        self.register_buffer("calibration", torch.ones(config.spreads, config.horizon))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[V,F] -> [V,sum(kernels)+spreads]: log weights of every bank's kernels, log factors."""
        return torch.as_tensor(self.out(torch.tanh(self.hidden(features))))


class KernelPrior(NamedTuple):
    """The same in numpy, for prediction."""

    hidden: tuple[Floats, Floats]  # [F,H], [H]
    out: tuple[Floats, Floats]  # [H,K], [K]
    cuts: tuple[int, ...]  # where one bank's weights end
    temperature: Floats  # [banks]
    calibration: Floats  # [spreads,M]
    dt: float  # s between the calibration's steps

    @staticmethod
    def of(network: PriorNetwork) -> KernelPrior:
        def array(value: torch.Tensor) -> Floats:
            return value.detach().to(torch.float64).numpy()

        return KernelPrior(
            (array(network.hidden.weight).T, array(network.hidden.bias)),
            (array(network.out.weight).T, array(network.out.bias)),
            tuple(np.cumsum(network.config.kernels).tolist()),
            np.exp(array(network.log_temperature)),
            array(network.calibration),
            network.config.dt,
        )

    def apply(self, features: Floats) -> tuple[list[Floats], Floats]:
        """[V,F] -> log prior [V,K] of each bank, factors of the standard deviations [V,spreads]."""
        raw = np.tanh(features @ self.hidden[0] + self.hidden[1]) @ self.out[0] + self.out[1]
        parts = np.split(raw, self.cuts, axis=1)
        return parts[:-1], np.exp(parts[-1])

    def calibrated(self, horizon: int, dt: float) -> Floats:
        """[spreads,M] factors at the steps asked for; beyond the last one calibrated, that one's."""
        known = self.dt * np.arange(1, self.calibration.shape[1] + 1)
        wanted = dt * np.arange(1, horizon + 1)
        return np.stack([np.interp(wanted, known, row) for row in self.calibration])


def trailing_run(state: Floats, valid: Bools) -> Ints:
    """[V] how many unbroken valid, finite frames lead up to now; state [V,N,>=4], valid [V,N]."""
    run = np.empty(len(state), np.int64)
    _trailing_run(state, valid, run)
    return run


def describe(state: Floats, run: Ints, dt: float) -> Floats:
    """The present motion as [V,FEATURES], each of order one; state [V,N,>=4], `run` from `trailing_run`.

    Speed, standing, acceleration and turning rate now, and how both changed over the known past; zeros for
    a vehicle that is not known now.
    """
    out = np.zeros((len(state), FEATURES))
    _describe(state, run, dt, out)
    return out


@compiled
def _trailing_run(state: Floats, valid: Bools, run: Ints) -> None:
    for v in range(state.shape[0]):
        run[v] = 0
        for k in range(state.shape[1] - 1, -1, -1):
            whole = valid[v, k]
            for f in range(4):
                whole = whole and np.isfinite(state[v, k, f])
            if not whole:
                break
            run[v] += 1


@compiled
def _describe(state: Floats, run: Ints, dt: float, out: Floats) -> None:
    now = state.shape[1] - 1
    for v in range(state.shape[0]):
        if run[v] == 0:
            continue
        last, first = now + 1 - min(run[v], 2), now + 1 - run[v]
        speed, heading = state[v, now, 2], state[v, now, 3]
        accel = np.tanh((speed - state[v, last, 2]) / dt / 2.0)
        turning = np.tanh((heading - state[v, last, 3]) / dt / 0.2)
        turned = np.tanh((heading - state[v, first, 3]) / 0.3)
        out[v, 0] = speed / 15.0 - 1.0
        out[v, 1] = out[v, 0] ** 2
        out[v, 2] = speed < STANDING
        out[v, 3] = np.exp(-speed / 2.0)
        out[v, 4] = accel
        out[v, 5] = abs(accel)
        out[v, 6] = turning
        out[v, 7] = abs(turning)
        out[v, 8] = np.tanh((speed - state[v, first, 2]) / 4.0)
        out[v, 9] = turned
        out[v, 10] = abs(turned)
