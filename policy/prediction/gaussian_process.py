"""A bank of Gaussian-process kernels on one shared time grid: every series' next seconds in one batch.

P, equations (1), (7), (8): a series is f ~ GP(m, k) with k = linear + RBF + white noise and time centred on
the newest frame. All series share one time grid, so for a finite bank of kernels (P's reference [14])
prediction is a matrix product with precomputed operators. Per series the kernels are averaged by marginal
likelihood times a prior over kernels; the most likely kernel alone is worse (measured, prediction.md).
"""

import itertools
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.types import Floats

MIN_KERNEL_WEIGHT = 1e-5  # kernels of lower weight are skipped: a hundred of them change a speed by mm/s


@dataclass(frozen=True, slots=True)
class BankConfig:
    """The kernels: every combination below, in units of `unit` and seconds."""

    unit: float  # typical variation of a series within 2 s, e.g. 1 m/s
    slope: tuple[float, ...]  # per s: standard deviation of the linear kernel's slope
    amplitude: tuple[float, ...]  # of the RBF part
    length: tuple[float, ...]  # s, RBF length scales
    noise: tuple[float, ...]  # white: simulated state is exact, a kernel's fit is not
    drift: tuple[float, ...] = (0.0,)  # per s: mean function m(t) = level + drift t of eq. (1c)
    bias: float = 10.0  # constant part of the linear kernel; wide: no pull towards a level

    def kernels(self) -> Floats:
        """[K,5] slope, amplitude, length, noise, drift."""
        return np.array(
            list(itertools.product(self.slope, self.amplitude, self.length, self.noise, self.drift))
        )


# m/s. Slopes and drifts in m/s2: cruising, ordinary and hard braking, acceleration.
SPEED = BankConfig(1.0, (0.2, 1.0), (0.5, 2.0), (1.0, 2.5), (0.02, 0.2), (-2.5, 0.0, 1.5))
# 0.05 rad: 1 m/s sideways at 20 m/s, a usual lane change. Drifts of 0.15 and 0.4 rad/s: round rings, corners.
HEADING = BankConfig(0.05, (0.2,), (0.5, 3.0), (0.7, 2.0), (0.02, 0.2), (-8.0, -3.0, 0.0, 3.0, 8.0))
# m, of "direct" positions: ahead and aside of the constant-speed position.
ALONG = BankConfig(1.0, (0.2, 2.0), (0.5, 2.0, 8.0), (1.0, 2.5, 5.0), (0.02, 0.2))
ACROSS = BankConfig(0.5, (0.2, 2.0), (0.5, 2.0, 8.0), (1.0, 2.5, 5.0), (0.02, 0.2))


class SeriesForecast(NamedTuple):
    """Moments of the mixture over kernels, and of its integral from now on (for positions)."""

    mean: Floats  # [S,M]
    variance: Floats  # [S,M]
    integral: Floats  # [S,M] unit * s, from now to each step
    integral_variance: Floats  # [S,M]


class Operators(NamedTuple):
    """The data-independent operators for histories of n frames, in the config's units.

    Axis 2M: the series at each step ahead, then its integral up to each step.
    """

    predict: Floats  # [n,K*M] past relative to the newest value -> the series ahead
    drift: Floats  # [K*M] contribution of the mean function
    whiten: Floats  # [n,K*n] past -> L^-1 (y - m)
    drift_white: Floats  # [K*n] the mean function's share of the past
    log_norm: Floats  # [K] the data-free part of the log marginal likelihood
    variance: Floats  # [K,2M]


class GaussianProcessBank:
    """Averaged kernel bank, `horizon` frames of `dt` s ahead, for histories of any number of frames."""

    def __init__(self, config: BankConfig, horizon: int = 20, dt: float = 0.2) -> None:
        self.config, self.horizon, self.dt = config, horizon, dt
        self.kernels = config.kernels()  # [K,5]

    def forecast(
        self, values: Floats, log_prior: Floats | None = None, temperature: float = 1.0
    ) -> SeriesForecast:
        """Forecast series of equal length (P, eq. 8, averaged over the kernels).

        Args:
            values: [S,n] oldest first.
            log_prior: [K] or [S,K] log weight of each kernel, uniform when None.
            temperature: divides the log marginal likelihood, which is overconfident under a wrong kernel.

        Returns:
            moments [S,M] in the series' own unit, and of the integral, unit * s.
        """
        op = self.operators(values.shape[1])
        k, m, s = len(self.kernels), self.horizon, len(values)
        level = np.ascontiguousarray(values[:, -1:])
        past = (values - level) / self.config.unit
        logit = np.zeros((s, k)) if log_prior is None else np.broadcast_to(log_prior, (s, k))
        if values.shape[1] > 1:  # a single value holds no evidence about the kernel
            logit = logit + self.evidence(past) / temperature
        weight = np.exp(logit - logit.max(1, keepdims=True))
        weight /= weight.sum(1, keepdims=True)  # [S,K]
        each = past @ op.predict
        each += op.drift
        mean, second = np.empty((s, 2 * m)), np.empty((s, 2 * m))
        _mix(weight, each.reshape(s, k, m), op.variance, self.dt, mean, second)
        variance = np.maximum(second - mean**2, 0.0) * self.config.unit**2
        mean *= self.config.unit
        elapsed = self.dt * np.arange(1, m + 1)
        return SeriesForecast(
            mean[:, :m] + level, variance[:, :m], mean[:, m:] + level * elapsed, variance[:, m:]
        )

    def evidence(self, past: Floats) -> Floats:
        """Log marginal likelihood of every kernel (P's reference [14]).

        Args:
            past: [S,n] series relative to their newest value, in units of `config.unit`.

        Returns:
            [S,K].
        """
        op = self.operators(past.shape[1])
        white = past @ op.whiten
        white -= op.drift_white
        white = white.reshape(-1, past.shape[1])
        distance = np.einsum("ij,ij->i", white, white).reshape(len(past), len(self.kernels))
        return np.asarray(op.log_norm - 0.5 * distance)

    def operators(self, count: int) -> Operators:
        """For histories of `count` frames; computed once."""
        return _operators(self.config, self.horizon, self.dt, count)


def covariance(kernel: Floats, a: Floats, b: Floats, bias: float) -> Floats:
    """Noise-free covariance of linear + RBF (P, eq. 7).

    Args:
        kernel: [>=3] slope, amplitude, length s, in the series' unit.
        a, b: times in s.
        bias: of the constant part.

    Returns:
        [len(a),len(b)].
    """
    slope, amplitude, length = kernel[:3]
    lag = a[:, None] - b[None, :]
    linear = bias**2 + slope**2 * a[:, None] * b[None, :]
    return np.asarray(linear + amplitude**2 * np.exp(-0.5 * (lag / length) ** 2))


def trapezoid(steps: int, dt: float) -> Floats:
    """[M,M] integral of a series up to each step, starting from 0 one step before the first."""
    return np.asarray(dt * (np.tri(steps) - 0.5 * np.eye(steps)))


@cache
def _operators(config: BankConfig, m: int, dt: float, count: int) -> Operators:
    past: Floats = dt * np.arange(1.0 - count, 1.0)  # s, 0 is now
    ahead: Floats = dt * np.arange(1.0, m + 1.0)
    integral = trapezoid(m, dt)  # linear in the prediction, so its moments are exact
    parts = []
    for kernel in config.kernels():
        gram = covariance(kernel, past, past, config.bias) + (kernel[3] ** 2 + 1e-9) * np.eye(count)
        lower = np.linalg.cholesky(gram)
        inverse = np.linalg.inv(lower)
        half = inverse @ covariance(kernel, past, ahead, config.bias)  # [n,M]
        posterior = covariance(kernel, ahead, ahead, config.bias) - half.T @ half
        operator = inverse.T @ half  # [n,M]
        parts.append(
            (
                operator,
                kernel[4] * (ahead - past @ operator),  # m(ahead) minus the prediction from m(past)
                inverse.T,
                inverse @ (kernel[4] * past),
                -np.log(np.diag(lower)).sum() - 0.5 * count * np.log(2 * np.pi),
                np.concatenate([np.diag(posterior), np.diag(integral @ posterior @ integral.T)]),
            )
        )
    predict, drift, whiten, drift_white, log_norm, variance = zip(*parts, strict=True)
    return Operators(
        np.concatenate(predict, 1),
        np.concatenate(drift),
        np.concatenate(whiten, 1),
        np.concatenate(drift_white),
        np.array(log_norm),
        np.maximum(np.array(variance), 0.0),
    )


@compiled
def _mix(
    weight: Floats,  # [S,K]
    each: Floats,  # [S,K,M] prediction of every kernel, relative to now
    variance: Floats,  # [K,2M]
    dt: float,
    mean: Floats,  # [S,2M] out
    second: Floats,  # [S,2M] out, second moment
) -> None:
    """Moments of the mixture, of the series and of its integral by the trapezoid rule (from 0 now)."""
    steps = each.shape[2]
    for s in range(weight.shape[0]):
        mean[s] = 0.0
        second[s] = 0.0
        for k in range(weight.shape[1]):
            w = weight[s, k]
            if w < MIN_KERNEL_WEIGHT:
                continue
            before = area = 0.0
            for i in range(steps):
                value = each[s, k, i]
                area += 0.5 * dt * (before + value)
                before = value
                mean[s, i] += w * value
                second[s, i] += w * (value * value + variance[k, i])
                mean[s, steps + i] += w * area
                second[s, steps + i] += w * (area * area + variance[k, steps + i])
