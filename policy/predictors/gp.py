"""The indirect Gaussian-process predictor (P, section IV-C) on the predictors' protocol."""

from __future__ import annotations

from cosim.types import Bools, Floats
from policy.forecast import KinematicForecast
from policy.gaussian_process import BankConfig, GaussianProcessBank


class GaussianProcessIndirect:
    """Speed and heading by the kernel bank, position by integration, with intervals."""

    name = "gp-indirect"

    def __init__(
        self,
        horizon: int = 20,
        dt: float = 0.2,
        frames: int = 10,
        config: BankConfig | None = None,
        log_prior: Floats | None = None,
    ) -> None:
        self.horizon, self.dt = horizon, dt
        self.bank = GaussianProcessBank(config, frames, horizon, dt, log_prior)

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """See `Predictor.predict`."""
        return self.bank.predict(kinematics, valid)
