"""The two simplest predictors (P's CS and CA): constant speed, and constant acceleration until standstill."""

from __future__ import annotations

import numpy as np

from cosim.types import HEADING, SPEED, Bools, Floats
from policy.forecast import KinematicForecast, integrate_position


class ConstantSpeed:
    """Straight on at the present speed."""

    name = "cs"

    def __init__(self, horizon: int = 20, dt: float = 0.2) -> None:
        self.horizon, self.dt = horizon, dt

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """See `Predictor.predict`."""
        now, known = newest(kinematics, valid)
        speed = np.repeat(now[:, SPEED, None], self.horizon, 1)
        return _straight(now, speed, known, self.dt)


class ConstantAcceleration:
    """Straight on with the acceleration of the last two frames, never backwards."""

    name = "ca"

    def __init__(self, horizon: int = 20, dt: float = 0.2) -> None:
        self.horizon, self.dt = horizon, dt

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """See `Predictor.predict`; one known frame only means constant speed."""
        now, known = newest(kinematics, valid)
        accel = np.zeros(len(now))
        if kinematics.shape[1] > 1:
            before = np.asarray(kinematics[:, -2, SPEED], dtype=np.float64)
            usable = known & valid[:, -2] & np.isfinite(before)
            accel = np.where(usable, (now[:, SPEED] - np.nan_to_num(before)) / self.dt, 0.0)
        elapsed = self.dt * np.arange(1, self.horizon + 1)
        speed = np.maximum(now[:, SPEED, None] + accel[:, None] * elapsed, 0.0)
        return _straight(now, speed, known, self.dt)


def newest(kinematics: Floats, valid: Bools) -> tuple[Floats, Bools]:
    """The newest state [V,4] (zeros where unknown) and who is known [V]."""
    now = np.asarray(kinematics[:, -1, :4], dtype=np.float64)
    known = valid[:, -1] & np.isfinite(now).all(1)
    return np.where(known[:, None], np.nan_to_num(now), 0.0), known


def _straight(now: Floats, speed: Floats, known: Bools, dt: float) -> KinematicForecast:
    heading = np.repeat(now[:, HEADING, None], speed.shape[1], 1)
    x, y = integrate_position(now, speed, heading, dt)
    return KinematicForecast.without_spread(x, y, speed, heading, known)
