"""The protocol of every kinematic predictor: a history of states in, the next frames of states out."""

from typing import Protocol

from cosim.types import Bools, Floats
from policy.prediction.forecast import KinematicForecast


class Predictor(Protocol):
    """A kinematic predictor (P, figure 5). Stateless: the same history gives the same forecast."""

    name: str
    horizon: int  # M, frames ahead
    dt: float  # s between frames

    def predict(self, kinematics: Floats, valid: Bools) -> KinematicForecast:
        """Forecast V vehicles M frames ahead.

        Args:
            kinematics: [V,N,>=4] x m, y m, speed m/s, heading rad (unwrapped), oldest first; nan: unknown.
            valid: [V,N] perceived in that frame.

        Returns:
            states and standard deviations [V,M]; zeros for vehicles that are not valid in the newest frame.
        """
