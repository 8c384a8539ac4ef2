"""A bank of Gaussian-process kernels on one shared time grid: every vehicle's next seconds in one batch.

P, equations (1), (7)-(9): speed and (unwrapped) heading are two independent series, each f ~ GP(m, k)
with k = linear + RBF + white noise, time centred on the newest frame; the position is the integral of
speed along heading ("indirect"). All series share one time grid, so for a finite bank of kernels (P's
reference [14]) prediction is a matrix product with operators computed once. Per series the kernels are
averaged by marginal likelihood times a prior over kernels; picking the best one is worse (measured).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.types import Bools, Floats
from policy.forecast import KinematicForecast, integrate_position


@dataclass(frozen=True, slots=True)
class BankConfig:
    """The kernels: every combination below. In units of `speed_unit` and `heading_unit`, and seconds."""

    speed_unit: float = 1.0  # m/s: the scale at which ordinary speeds vary within 2 s
    heading_unit: float = 0.05  # rad: 1 m/s sideways at 20 m/s, a usual lane change
    bias: float = 10.0  # the constant part of the linear kernel, wide: no pull towards the mean
    slope: tuple[float, ...] = (0.2, 1.0, 3.0)  # per s; as m/s2: cruising, ordinary, hard braking
    amplitude: tuple[float, ...] = (0.5, 2.0)  # of the RBF part
    length: tuple[float, ...] = (1.0, 2.5)  # s, RBF length scales: shorter ones only follow noise
    noise: tuple[float, ...] = (0.02, 0.2)  # white: simulated state is exact, shared perception is not
    temperature: float = 1.0  # of the marginal likelihood; fitted together with the prior over kernels

    def kernels(self) -> Floats:
        """[K,4] slope, amplitude, length, noise."""
        return np.array(list(itertools.product(self.slope, self.amplitude, self.length, self.noise)))


class SeriesForecast(NamedTuple):
    """Moments of the mixture over kernels, and of the integral from now on (for positions)."""

    mean: Floats  # [S,M]
    variance: Floats  # [S,M]
    integral: Floats  # [S,M] unit * s, from now to each step
    integral_variance: Floats  # [S,M]


class _Operators(NamedTuple):
    """Everything that does not depend on the data, for histories of n frames.

    Along 2M: the series at each step ahead, then its integral up to each step.
    """

    predict: Floats  # [n,K*2M] centred values -> means
    whiten: Floats  # [n,K*n] centred values -> L^-1 y
    log_norm: Floats  # [K] the data-free part of the log marginal likelihood
    variance: Floats  # [K,2M]


class GaussianProcessBank:
    """Averaged kernel bank for histories of up to `frames` frames, `horizon` frames ahead, `dt` s apart.

    `log_prior` [K]: log weight of each kernel (fitted on recorded episodes); uniform when None.
    """

    def __init__(
        self,
        config: BankConfig | None = None,
        frames: int = 10,
        horizon: int = 20,
        dt: float = 0.2,
        log_prior: Floats | None = None,
    ) -> None:
        self.config = config or BankConfig()
        self.frames, self.horizon, self.dt = frames, horizon, dt
        self.kernels = self.config.kernels()  # [K,4]
        self.log_prior = np.zeros(len(self.kernels)) if log_prior is None else np.asarray(log_prior, float)
        if self.log_prior.shape != (len(self.kernels),):
            raise ValueError(f"log_prior must have shape ({len(self.kernels)},), got {self.log_prior.shape}")
        self._operators: dict[int, _Operators] = {}

    def covariance(self, kernel: Floats, a: Floats, b: Floats) -> Floats:
        """Noise-free covariance k(a, b) of one kernel (a row of `kernels`); times in s -> [len(a),len(b)]."""
        slope, amplitude, length, _ = kernel
        lag = a[:, None] - b[None, :]
        linear = self.config.bias**2 + slope**2 * a[:, None] * b[None, :]
        return np.asarray(linear + amplitude**2 * np.exp(-0.5 * (lag / length) ** 2))

    def forecast_series(self, values: Floats, count: int) -> SeriesForecast:
        """Forecast series that all have `count` frames: [S,count], oldest first -> moments [S,M]."""
        op = self._operators_for(count)
        k, m, s = len(self.kernels), self.horizon, len(values)
        level = values.mean(1, keepdims=True)  # m(t) in eq. (1c): constant
        centred = values - level
        if count > 1:
            white = (centred @ op.whiten).reshape(s * k, count)
            evidence = op.log_norm - 0.5 * np.einsum("ij,ij->i", white, white).reshape(s, k)
            logit = evidence / self.config.temperature + self.log_prior
        else:  # one value says nothing about the kernel: the prior alone
            logit = np.broadcast_to(self.log_prior, (s, k))
        weight = np.exp(logit - logit.max(1, keepdims=True))
        weight /= weight.sum(1, keepdims=True)  # [S,K]
        means = (centred @ op.predict).reshape(s, k, 2 * m)
        mean = np.matmul(weight[:, None], means)[:, 0]  # [S,2M]: of the mixture
        np.square(means, out=means)
        second = np.matmul(weight[:, None], means)[:, 0] + weight @ op.variance
        variance = np.maximum(second - mean**2, 0.0)
        elapsed = self.dt * np.arange(1, m + 1)
        return SeriesForecast(
            mean[:, :m] + level, variance[:, :m], mean[:, m:] + level * elapsed, variance[:, m:]
        )

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """Forecast vehicles. kinematics [V,N,>=4] x m, y m, speed m/s, heading rad (unwrapped); valid [V,N].

        Only the unbroken run of valid, finite frames up to the newest counts; a vehicle that is not valid
        in the newest frame gets no forecast (`valid` False, zeros). Position by eq. (9).
        """
        state = np.asarray(kinematics[:, :, :4], dtype=np.float64)
        good = valid & np.isfinite(state).all(2)  # [V,N]
        run = np.cumprod(good[:, ::-1], axis=1).sum(1)  # [V] valid trailing frames
        vehicles = len(state)
        speed = np.zeros((2, vehicles, self.horizon))  # mean, variance
        along = np.zeros((vehicles, self.horizon))  # m^2
        heading = np.zeros((2, vehicles, self.horizon))
        turned = np.zeros((vehicles, self.horizon))  # (rad s)^2
        unit_v, unit_h = self.config.speed_unit, self.config.heading_unit
        for count in np.unique(run[run > 0]):
            rows = np.flatnonzero(run == count)
            series = state[rows, -count:]
            both = np.concatenate([series[:, :, 2] / unit_v, series[:, :, 3] / unit_h])  # [2S,count]
            f = self.forecast_series(both, int(count))
            s = len(rows)
            speed[0, rows], speed[1, rows] = f.mean[:s] * unit_v, f.variance[:s] * unit_v**2
            heading[0, rows], heading[1, rows] = f.mean[s:] * unit_h, f.variance[s:] * unit_h**2
            along[rows] = f.integral_variance[:s] * unit_v**2
            turned[rows] = f.integral_variance[s:] * unit_h**2
        known = run > 0
        now = np.where(known[:, None], np.nan_to_num(state[:, -1]), 0.0)  # [V,4]
        v = np.maximum(speed[0], 0.0)  # nobody reverses
        x, y = integrate_position(now, v, heading[0], self.dt)
        # eq. (9) linearised: along by the integral of speed, across by the turned angle at mean speed
        elapsed = self.dt * np.arange(1, self.horizon + 1)
        mean_speed = np.sqrt((x - now[:, :1]) ** 2 + (y - now[:, 1:2]) ** 2) / elapsed
        return KinematicForecast(
            x,
            y,
            v,
            heading[0],
            np.sqrt(speed[1]),
            np.sqrt(heading[1]),
            np.sqrt(along),
            mean_speed * np.sqrt(turned),
            known,
        )

    def _operators_for(self, count: int) -> _Operators:
        found = self._operators.get(count)
        if found is None:
            found = self._operators[count] = self._build(count)
        return found

    def _build(self, count: int) -> _Operators:
        m = self.horizon
        past: Floats = self.dt * np.arange(1.0 - count, 1.0)  # s, 0 is now
        ahead: Floats = self.dt * np.arange(1.0, m + 1.0)
        # trapezoid from the newest value on: linear in the prediction, so its moments are exact
        integral = np.tril(np.full((m, m), self.dt))  # [M,M]
        integral[np.diag_indices(m)] = 0.5 * self.dt
        newest = np.zeros((count, m))
        newest[-1] = 0.5 * self.dt
        predict, whiten, log_norm, variance = [], [], [], []
        for kernel in self.kernels:
            gram = self.covariance(kernel, past, past) + (kernel[3] ** 2 + 1e-9) * np.eye(count)
            lower = np.linalg.cholesky(gram)
            inverse = np.linalg.inv(lower)
            half = inverse @ self.covariance(kernel, past, ahead)  # [n,M]
            posterior = self.covariance(kernel, ahead, ahead) - half.T @ half
            operator = inverse.T @ half  # [n,M]
            predict += [operator, newest + operator @ integral.T]
            whiten.append(inverse.T)
            log_norm.append(-np.log(np.diag(lower)).sum() - 0.5 * count * np.log(2 * np.pi))
            variance.append(np.concatenate([np.diag(posterior), np.diag(integral @ posterior @ integral.T)]))
        return _Operators(
            np.concatenate(predict, 1),
            np.concatenate(whiten, 1),
            np.array(log_norm),
            np.maximum(np.array(variance), 0.0),
        )
