"""The reference that the kernel bank is measured against: one Gaussian process per series, its kernel fitted.

P's method as it reads: linear + RBF + white noise, hyperparameters by maximum marginal likelihood on the 2 s
of each series. Three orders of magnitude slower than the bank, and no better (docs/prediction.md).
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import minimize

from cosim.types import Floats
from policy.prediction.gaussian_process import covariance

BIAS = 10.0  # in units of the series, as in the bank
START = (1.0, 1.0, 1.5, 0.1)  # slope, amplitude, length s, noise
BOUNDS = ((0.02, 20.0), (0.02, 20.0), (0.3, 10.0), (0.005, 1.0))
LOG_2PI = float(np.log(2 * np.pi))


class Fitted(NamedTuple):
    """One series' kernel and forecast."""

    kernel: Floats  # [4] slope, amplitude, length, noise
    log_likelihood: float
    mean: Floats  # [M]
    std: Floats  # [M] noise-free


def fit_series(values: Floats, unit: float, horizon: int = 20, dt: float = 0.2) -> Fitted:
    """Fit and forecast one series (P, eq. 7 and 8).

    Args:
        values: [n] oldest first, n >= 2, in the series' own unit.
        unit: in which the kernel is given.
        horizon: M, frames ahead.
        dt: s between frames.
    """
    past = dt * np.arange(1.0 - len(values), 1.0)
    ahead = dt * np.arange(1.0, horizon + 1.0)
    y = (values - values.mean()) / unit
    found = minimize(
        _loss,
        np.log(START),
        args=(past, y),
        jac=True,
        method="L-BFGS-B",
        bounds=[(np.log(low), np.log(high)) for low, high in BOUNDS],
    )
    kernel = np.exp(found.x)
    lower = cholesky(_gram(kernel, past), lower=True)
    cross = covariance(kernel, ahead, past, BIAS)
    mean = cross @ cho_solve((lower, True), y)
    half = np.linalg.solve(lower, cross.T)
    variance = np.diag(covariance(kernel, ahead, ahead, BIAS)) - (half**2).sum(0)
    return Fitted(
        kernel, -float(found.fun), values.mean() + unit * mean, unit * np.sqrt(np.maximum(variance, 0.0))
    )


def _gram(kernel: Floats, past: Floats) -> Floats:
    return np.asarray(covariance(kernel, past, past, BIAS) + (kernel[3] ** 2 + 1e-9) * np.eye(len(past)))


def _loss(log_kernel: Floats, past: Floats, y: Floats) -> tuple[float, Floats]:
    """Negative log marginal likelihood and its gradient with respect to the logarithms."""
    kernel = np.exp(log_kernel)
    slope, amplitude, length, noise = kernel
    lower = cholesky(_gram(kernel, past), lower=True)
    inverse = cho_solve((lower, True), np.eye(len(past)))
    alpha = inverse @ y
    value = 0.5 * y @ alpha + np.log(np.diag(lower)).sum() + 0.5 * len(y) * LOG_2PI
    lag2 = ((past[:, None] - past[None, :]) / length) ** 2
    smooth = amplitude**2 * np.exp(-0.5 * lag2)
    parts = (
        2 * slope**2 * np.outer(past, past),
        2 * smooth,
        smooth * lag2,
        2 * noise**2 * np.eye(len(past)),
    )
    inner = np.outer(alpha, alpha) - inverse
    return float(value), np.array([-0.5 * (inner * part).sum() for part in parts])
