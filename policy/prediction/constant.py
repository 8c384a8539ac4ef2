"""No prediction, and P's two simplest predictors: constant speed (CS), constant acceleration (CA)."""

import numpy as np

from cosim.types import HEADING, SPEED, Bools, Floats
from policy.prediction.forecast import KinematicForecast, integrate_position


class ConstantSpeed:
    """Straight on at the present speed."""

    name = "cs"

    def __init__(self, horizon: int = 20, dt: float = 0.2) -> None:
        self.horizon, self.dt = horizon, dt

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """See `Predictor.predict`."""
        now, known = newest(kinematics, valid)
        gain = self.acceleration(kinematics, valid)[:, None] * (self.dt * np.arange(1, self.horizon + 1))
        speed = np.maximum(now[:, SPEED, None] + gain, 0.0)
        heading = np.repeat(now[:, HEADING, None], self.horizon, 1)
        x, y = integrate_position(now, speed, heading, self.dt)
        return KinematicForecast.without_spread(x, y, speed, heading, known)

    def acceleration(self, kinematics: Floats, valid: Bools) -> Floats:
        """[V] m/s2; arguments as in `predict`."""
        return np.zeros(len(kinematics))


class Hold(ConstantSpeed):
    """No prediction: every vehicle stays where it is, at speed 0 from the next frame on."""

    name = "hold"

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """See `Predictor.predict`."""
        now, known = newest(kinematics, valid)
        x, y, _, heading = (np.repeat(now[:, k, None], self.horizon, 1) for k in range(4))
        return KinematicForecast.without_spread(x, y, np.zeros_like(x), heading, known)


class ConstantAcceleration(ConstantSpeed):
    """Straight on with the acceleration of the last two frames, never backwards."""

    name = "ca"

    def acceleration(self, kinematics: Floats, valid: Bools) -> Floats:
        """[V] m/s2; 0 where only one frame is known."""
        last = np.asarray(kinematics[:, -2:, SPEED], dtype=np.float64)
        usable = valid[:, -2:].all(1) & np.isfinite(kinematics[:, -1, :4]).all(1) & np.isfinite(last).all(1)
        return np.where(usable, np.nan_to_num(last[:, -1] - last[:, 0]) / self.dt, 0.0)


def newest(kinematics: Floats, valid: Bools) -> tuple[Floats, Bools]:
    """The newest state [V,4] (zeros where unknown) and its validity [V]."""
    now = np.asarray(kinematics[:, -1, :4], dtype=np.float64)
    known = valid[:, -1] & np.isfinite(now).all(1)
    return np.where(known[:, None], np.nan_to_num(now), 0.0), known
