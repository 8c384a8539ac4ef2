"""Gaussian-process predictors (P, section IV-C): "indirect" by speed and heading, "direct" by positions."""

from pathlib import Path

import numpy as np

from cosim.types import Bools, Floats
from policy.checkpoint import SHIPPED, load
from policy.prediction.forecast import KinematicForecast, integrate_position, motion_of
from policy.prediction.gaussian_process import ACROSS, ALONG, HEADING, SPEED, BankConfig, GaussianProcessBank
from policy.prediction.kernel_prior import KernelPrior, PriorConfig, PriorNetwork, describe
from policy.prediction.past import trailing_run, whole_past


class _GaussianProcess:
    """Common base: banks, their learned prior, completed histories.

    `weights`: the fitted prior and calibration, as an object or a file; None: the shipped one.
    """

    name: str
    configs: tuple[BankConfig, BankConfig]
    spreads: int  # quantities with an interval

    def __init__(
        self,
        horizon: int = 20,
        dt: float = 0.2,
        weights: Path | PriorNetwork | None = None,
    ) -> None:
        self.horizon, self.dt = horizon, dt
        self.banks = tuple(GaussianProcessBank(c, horizon, dt) for c in self.configs)
        if isinstance(weights, PriorNetwork):
            network = weights
        else:
            network = PriorNetwork(self.prior_config())
            file = weights or SHIPPED / f"{self.name}.safetensors"
            load(file, {"prior": network}, {"prior": network.config})
        self.prior = KernelPrior.of(network)
        self._calibration = self.prior.calibrated(horizon, dt)

    @classmethod
    def prior_config(cls) -> PriorConfig:
        """The layout of this predictor's prior."""
        return PriorConfig(tuple(len(c.kernels()) for c in cls.configs), cls.spreads)

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """See `Predictor.predict`; P, eq. 7 to 9.

        Only the unbroken run of valid, finite frames up to now counts; earlier frames are completed
        (`policy.prediction.past`). A vehicle that is not valid now gets no forecast (`valid` False, zeros).
        """
        state = np.asarray(kinematics[:, :, :4], dtype=np.float64)
        run = trailing_run(state, valid)
        known = run > 0
        frames = len(self._calibration)
        past = whole_past(state, run, frames, self.dt)  # [V,N,4]
        logs, spread = self.prior.apply(describe(past, known, self.dt))
        moments = np.empty((len(self.banks), 4, len(state), self.horizon))
        for b, (bank, series) in enumerate(zip(self.banks, self.series(past), strict=True)):
            moments[b] = bank.forecast(series, logs[b], float(self.prior.temperature[b]))
        moments[:, :, ~known] = 0.0
        factor = self._calibration[np.clip(run, 1, frames) - 1]  # [V,spreads,M]
        return self._forecast(past[:, -1], moments, (spread[:, :, None] * factor).swapaxes(0, 1), known)

    def series(self, state: Floats) -> tuple[Floats, Floats]:
        """Two series [S,n] of states [S,n,4]."""
        raise NotImplementedError

    def _forecast(self, now: Floats, moments: Floats, scale: Floats, known: Bools) -> KinematicForecast:
        """The forecast; moments [2,4,V,M] mean, variance, integral, its variance; scale [spreads,V,M]."""
        raise NotImplementedError


class GaussianProcessIndirect(_GaussianProcess):
    """Speed and heading by the kernel bank, position by integration (eq. 9), with intervals."""

    name = "gp-indirect"
    configs = (SPEED, HEADING)
    spreads = 4

    def series(self, state: Floats) -> tuple[Floats, Floats]:
        return state[:, :, 2], state[:, :, 3]

    def _forecast(self, now: Floats, moments: Floats, scale: Floats, known: Bools) -> KinematicForecast:
        (v, v_var, _, along_var), (h, h_var, _, turned_var) = moments
        v = np.maximum(v, 0.0)  # vehicles do not reverse
        x, y = integrate_position(now, v, h, self.dt)
        # eq. (9) linearised: along by the integral of speed, across by the turned angle at mean speed
        elapsed = self.dt * np.arange(1, self.horizon + 1)
        mean_speed = np.sqrt((x - now[:, :1]) ** 2 + (y - now[:, 1:2]) ** 2) / elapsed
        across = mean_speed * np.sqrt(turned_var)
        std = scale * np.stack([np.sqrt(v_var), np.sqrt(h_var), np.sqrt(along_var), across]) * known[:, None]
        return KinematicForecast(x, y, v, h, std[0], std[1], std[2], std[3], known)


class GaussianProcessDirect(_GaussianProcess):
    """Positions by the kernel bank, in the vehicle's own frame; speed and heading follow.

    The mean function is straight motion at the present speed: a single frame gives constant speed.
    """

    name = "gp-direct"
    configs = (ALONG, ACROSS)
    spreads = 2

    def series(self, state: Floats) -> tuple[Floats, Floats]:
        dx, dy = state[:, :, 0] - state[:, -1:, 0], state[:, :, 1] - state[:, -1:, 1]
        c, s = np.cos(state[:, -1:, 3]), np.sin(state[:, -1:, 3])
        past = self.dt * np.arange(1 - state.shape[1], 1)
        return c * dx + s * dy - state[:, -1:, 2] * past, c * dy - s * dx

    def _forecast(self, now: Floats, moments: Floats, scale: Floats, known: Bools) -> KinematicForecast:
        (u, u_var), (w, w_var) = moments[:, :2]
        u = u + now[:, 2:3] * (self.dt * np.arange(1, self.horizon + 1))
        c, s = np.cos(now[:, 3:4]), np.sin(now[:, 3:4])
        x, y = now[:, :1] + c * u - s * w, now[:, 1:2] + s * u + c * w
        speed, heading = motion_of(now, x, y, self.dt)
        u_var, w_var = scale**2 * np.stack([u_var, w_var]) * known[:, None]
        c, s = np.cos(heading - now[:, 3:4]), np.sin(heading - now[:, 3:4])
        along, across = np.sqrt(c**2 * u_var + s**2 * w_var), np.sqrt(s**2 * u_var + c**2 * w_var)
        zero = np.zeros_like(x)
        return KinematicForecast(x, y, speed, heading, zero, zero, along, across, known)
