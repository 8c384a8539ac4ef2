"""Fits of the kinematic predictors: the prior over kernels, its calibration, and P's learned baselines.

All use the same windows of recorded episodes and minimise the mean position error over the horizon (PE), so
that their table compares methods, not objectives.
"""

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from cosim.types import Bools, Floats
from policy.networks.seeded import seeded
from policy.prediction.gaussian_process import GaussianProcessBank, Operators, trapezoid
from policy.prediction.gp import GaussianProcessDirect, GaussianProcessIndirect
from policy.prediction.kernel_prior import PriorNetwork, describe
from policy.prediction.learned import KinematicNet, NetConfig, features, integrate
from policy.training.loop import Line, LoopConfig, Progress, Task, train

Batch = Mapping[str, torch.Tensor]  # name -> [S,...], S the same for all
Loss = Callable[[Batch], torch.Tensor]
VALIDATION_EXAMPLES = 8192  # approximate number of validation examples per loss
COVERAGE = 0.9  # nominal coverage of an interval
COVERAGE_DEVIATIONS = 1.645  # half of its width in standard deviations, for normal errors
SPREAD_WEIGHT = 0.05  # of the intervals' loss, small enough not to move the mean forecast
SPREAD_SAMPLES = slice(None, None, 4)  # part of a batch: intervals cost more than the mean and need less data

GaussianProcess = type[GaussianProcessIndirect] | type[GaussianProcessDirect]


class Windows(NamedTuple):
    """S moments of single vehicles with a completely known past, each in its own frame at that moment."""

    past: Floats  # [S,N,4] x m ahead, y m left, speed m/s, heading rad
    future: Floats  # [S,M,4] nan after the vehicle left
    weight: Floats  # [S] mean 1


def in_own_frame(past: Floats, future: Floats, weight: Floats) -> Windows:
    """Windows from world coordinates [S,N,4], [S,M,4]; an unknown past or no future is left out."""
    whole = np.isfinite(past).all((1, 2)) & np.isfinite(future[:, 0]).all(1)
    past, future, weight = past[whole], future[whole], weight[whole]
    now = past[:, -1:]
    c, s = np.cos(now[:, :, 3]), np.sin(now[:, :, 3])

    def turned(world: Floats) -> Floats:
        dx, dy = world[:, :, 0] - now[:, :, 0], world[:, :, 1] - now[:, :, 1]
        return np.stack([c * dx + s * dy, c * dy - s * dx, world[:, :, 2], world[:, :, 3] - now[:, :, 3]], -1)

    return Windows(turned(past), turned(future), weight / weight.mean())


def examples_for_net(windows: Windows) -> dict[str, torch.Tensor]:
    """The inputs of `net_loss` for each window."""
    return {
        "past": features(windows.past, np.ones(len(windows.past), np.bool_)),
        "speed": _tensor(windows.past[:, -1, 2]),
        **_truth(windows),
    }


def fresh_net(config: NetConfig, seed: int) -> KinematicNet:
    """An untrained network, the same for equal seeds."""
    return seeded(lambda: KinematicNet(config), seed)


def net_loss(network: KinematicNet, batch: Batch) -> torch.Tensor:
    """Mean position error of an LSTM's or autoencoder's forecast, m."""
    x, y = network(batch["past"], batch["speed"])[:2]
    return position_error(x, y, batch)


def position_error(x: torch.Tensor, y: torch.Tensor, batch: Batch) -> torch.Tensor:
    """PE: distance between forecast and truth, mean over known frames, then over vehicles."""
    here = batch["here"]
    squared = (x - batch["future"][:, :, 0]) ** 2 + (y - batch["future"][:, :, 1]) ** 2
    error = torch.sqrt(squared + 1e-6) * here  # differentiable at 0
    return (error.sum(1) / here.sum(1) * batch["weight"]).mean()


class BankMath(nn.Module):
    """`GaussianProcessBank.forecast` in torch, so that gradients reach the prior over kernels."""

    table: torch.Tensor  # [K*(n+1),M] past and 1 -> the series ahead, by kernel
    both: torch.Tensor  # [n+1,K*2M] the same, and its integral
    variance: torch.Tensor
    integral: torch.Tensor

    def __init__(self, bank: GaussianProcessBank, frames: int) -> None:
        super().__init__()
        op: Operators = bank.operators(frames)
        self.unit, self.kernels, self.steps = bank.config.unit, len(bank.kernels), bank.horizon
        each = np.concatenate([op.predict, op.drift[None]]).reshape(frames + 1, self.kernels, self.steps)
        self.register_buffer("table", _tensor(each.swapaxes(0, 1).reshape(-1, self.steps)), persistent=False)
        integral = trapezoid(bank.horizon, bank.dt).T
        both = np.concatenate([each, each @ integral], 2).reshape(frames + 1, -1)
        for name, values in (("both", both), ("variance", op.variance), ("integral", integral)):
            self.register_buffer(name, _tensor(values), persistent=False)

    def forward(
        self, past: torch.Tensor, evidence: torch.Tensor, log_prior: torch.Tensor, heat: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """past [S,n] relative to now in the unit, evidence, log_prior [S,K] -> mean [S,2M], deviation [.,2M].

        The deviation covers the examples SPREAD_SAMPLES; no gradient flows through it.
        """
        weight = torch.softmax(evidence / heat + log_prior, 1)
        seen = torch.cat([past, torch.ones_like(past[:, :1])], 1)  # [S,n+1]
        mean = (weight[:, :, None] * seen[:, None]).flatten(1) @ self.table
        mean = torch.cat([mean, mean @ self.integral], 1)
        with torch.no_grad():
            few = weight[SPREAD_SAMPLES]
            means = (seen[SPREAD_SAMPLES] @ self.both).view(-1, self.kernels, 2 * self.steps)
            second = torch.bmm(few[:, None], means.square_())[:, 0] + few @ self.variance
            deviation = torch.sqrt((second - mean[SPREAD_SAMPLES] ** 2).clamp(min=0.0) + 1e-8)
        return self.unit * mean, self.unit * deviation


class PriorFit:
    """One Gaussian-process predictor's prior: its examples, its loss, its calibration."""

    def __init__(self, kind: GaussianProcess, seed: int = 0) -> None:
        self.network = seeded(lambda: PriorNetwork(kind.prior_config()), seed)
        self.predictor = kind(weights=self.network)
        self._math = [BankMath(bank, self.network.config.frames) for bank in self.predictor.banks]

    def examples(self, windows: Windows) -> dict[str, torch.Tensor]:
        """The inputs of `loss` for each window."""
        known = np.ones(len(windows.past), np.bool_)
        found = {
            "motion": _tensor(describe(windows.past, known, self.predictor.dt)),
            "speed": _tensor(windows.past[:, -1, 2]),
            **_truth(windows),
        }
        both = self.predictor.series(windows.past)
        for b, (bank, series) in enumerate(zip(self.predictor.banks, both, strict=True)):
            past = (series - series[:, -1:]) / bank.config.unit
            parts = [bank.evidence(part) for part in np.array_split(past, max(len(past) // 20_000, 1))]
            evidence = np.concatenate(parts)
            found[f"past{b}"] = _tensor(past)
            found[f"evidence{b}"] = _tensor(evidence - evidence.max(1, keepdims=True))
        return found

    def fitted(self) -> GaussianProcessIndirect | GaussianProcessDirect:
        """The predictor with the present prior."""
        return type(self.predictor)(weights=self.network)

    def calibrate(self, factors: Floats) -> None:
        """Set the factors [N,spreads,M] on the standard deviations, by number of known frames."""
        self.network.calibration.copy_(torch.from_numpy(factors))

    def loss(self, batch: Batch) -> torch.Tensor:
        """Position error plus SPREAD_WEIGHT times the intervals' pinball loss."""
        raw = self.network(batch["motion"])
        kernels = self.network.config.kernels
        *priors, spread = torch.split(raw, [*kernels, self.network.config.spreads], 1)
        heat = self.network.log_temperature.exp()
        m = self.predictor.horizon
        first, second = (
            math(batch[f"past{b}"], batch[f"evidence{b}"], priors[b], heat[b])
            for b, math in enumerate(self._math)
        )
        future, here = batch["future"], batch["here"]
        if isinstance(self.predictor, GaussianProcessDirect):
            ahead = self.predictor.dt * torch.arange(1, m + 1)
            x, y = batch["speed"][:, None] * ahead + first[0][:, :m], second[0][:, :m]
            errors = [x - future[:, :, 0], y - future[:, :, 1]]
            deviations = [first[1][:, :m], second[1][:, :m]]
        else:
            v = (batch["speed"][:, None] + first[0][:, :m]).clamp(min=0.0)
            h = second[0][:, :m]
            x, y = integrate(batch["speed"], v, h, self.predictor.dt)
            elapsed = self.predictor.dt * torch.arange(1, m + 1)
            dx, dy = future[:, :, 0] - x, future[:, :, 1] - y
            c, s = torch.cos(h), torch.sin(h)
            errors = [v - future[:, :, 2], h - future[:, :, 3], c * dx + s * dy, c * dy - s * dx]
            across = (torch.sqrt(x**2 + y**2 + 1e-6) / elapsed)[SPREAD_SAMPLES].detach() * second[1][:, m:]
            deviations = [first[1][:, :m], second[1][:, :m], first[1][:, m:], across]
        total = position_error(x, y, batch)
        here, weight, spread = here[SPREAD_SAMPLES], batch["weight"][SPREAD_SAMPLES], spread[SPREAD_SAMPLES]
        for k, (error, deviation) in enumerate(zip(errors, deviations, strict=True)):
            unit = (1.0, 0.05, 1.0, 0.5)[k] if len(errors) == 4 else (1.0, 0.5)[k]
            edge = COVERAGE_DEVIATIONS * deviation * torch.exp(spread[:, k : k + 1])
            beyond = (error[SPREAD_SAMPLES].detach().abs() - edge) / unit
            pinball = torch.maximum(COVERAGE * beyond, (COVERAGE - 1.0) * beyond) * here
            total = total + SPREAD_WEIGHT * (pinball.sum(1) / here.sum(1) * weight).mean()
        return total


def factors_for(forecast_std: tuple[Floats, ...], errors: tuple[Floats, ...], weight: Floats) -> Floats:
    """[quantities,M] factor on each standard deviation, so that an interval of COVERAGE_DEVIATIONS covers the
    share COVERAGE of the errors [S,M] (nan without truth)."""
    factors = np.ones((len(errors), errors[0].shape[1]))
    for q, (error, std) in enumerate(zip(errors, forecast_std, strict=True)):
        for step in range(error.shape[1]):
            ratio = np.abs(error[:, step]) / np.maximum(COVERAGE_DEVIATIONS * std[:, step], 1e-9)
            there = np.isfinite(ratio)
            factors[q, step] = _quantile(ratio[there], weight[there], COVERAGE)
    return factors


def _quantile(values: Floats, weight: Floats, share: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, share * total[-1])]])


def _truth(windows: Windows) -> dict[str, torch.Tensor]:
    here: Bools = np.isfinite(windows.future[:, :, 0])
    return {
        "future": _tensor(np.nan_to_num(windows.future)),
        "here": _tensor(here),
        "weight": _tensor(windows.weight),
    }


def _tensor(values: Floats | Bools) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


@dataclass(frozen=True, slots=True)
class FitConfig:
    """One fit with Adam and a cosine schedule of the learning rate down to 0."""

    steps: int = 6000
    batch: int = 1024
    learning_rate: float = 1e-2
    seed: int = 0


class FitTask(Task):
    """Training of one network by one loss; arguments as in `fit`."""

    def __init__(
        self, network: nn.Module, loss: Loss, config: FitConfig, examples: Batch, validation: Batch
    ) -> None:
        self._loss, self._config, self._examples = loss, config, examples
        stride = max(len(next(iter(validation.values()))) // VALIDATION_EXAMPLES, 1)
        checked = {name: tensor[::stride] for name, tensor in validation.items()}
        adam = torch.optim.Adam(network.parameters(), config.learning_rate)
        super().__init__(network, adam, self._rate, [(checked, 1)])

    def _rate(self, number: int) -> float:
        c = self._config
        return 0.5 * c.learning_rate * (1.0 + math.cos(math.pi * number / c.steps))

    def batch(self, number: int) -> Batch:
        """See `Task.batch`."""
        rng = np.random.default_rng((self._config.seed, number))
        count = len(next(iter(self._examples.values())))
        rows = torch.from_numpy(rng.integers(0, count, self._config.batch))
        return {name: tensor[rows] for name, tensor in self._examples.items()}

    def losses(self, batch: Batch) -> dict[str, torch.Tensor]:
        """See `Task.losses`."""
        return {"loss": self._loss(batch)}


def fit(
    network: nn.Module,
    loss: Loss,
    config: FitConfig,
    examples: Batch,
    validation: Batch,
    *,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> list[Line]:
    """Fit `network` in place; returns the log of losses. A state in `folder` is resumed.

    Raises BadInput when `folder` holds another fit.
    """
    task = FitTask(network, loss, config, examples, validation)
    shapes = {name: list(value.shape) for name, value in network.state_dict().items()}
    layout = {"config": asdict(config), "shapes": shapes, "examples": len(next(iter(examples.values())))}
    times = LoopConfig(updates=config.steps)
    with tempfile.TemporaryDirectory(prefix="cosim-fit-") as scratch:
        where = folder or Path(scratch)
        return train(task, times, where, layout=layout, resume=True, progress=progress)
