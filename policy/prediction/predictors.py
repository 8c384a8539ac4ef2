"""Kinematic predictors by name: P's eight, no prediction (`hold`), and a user's class."""

from collections.abc import Callable
from functools import partial

from cosim.errors import BadInput, one_of
from cosim.files import code
from policy.prediction.constant import ConstantAcceleration, ConstantSpeed, Hold
from policy.prediction.forecast import KinematicForecast
from policy.prediction.gp import GaussianProcessDirect, GaussianProcessIndirect
from policy.prediction.learned import Learned, NetConfig
from policy.prediction.protocol import Predictor

PREDICTORS: dict[str, Callable[[int, float], Predictor]] = {
    "cs": ConstantSpeed,
    "ca": ConstantAcceleration,
    "lstm-direct": partial(Learned, NetConfig("lstm", "direct")),
    "lstm-indirect": partial(Learned, NetConfig("lstm", "indirect")),
    "ae-direct": partial(Learned, NetConfig("ae", "direct")),
    "ae-indirect": partial(Learned, NetConfig("ae", "indirect")),
    "gp-direct": GaussianProcessDirect,
    "gp-indirect": GaussianProcessIndirect,
}
MASK_PREDICTORS: dict[str, Callable[[int, float], Predictor]] = {"hold": Hold, **PREDICTORS}


def make_predictor(name: str, horizon: int, dt: float) -> Predictor:
    """A predictor for `horizon` frames of `dt` s: from the table, or the class FILE.py:NAME or MODULE:NAME.

    Raises BadInput for an unknown name, or a user's class that cannot be loaded or called or is incomplete.
    """
    if not code.is_code(name):
        return MASK_PREDICTORS[one_of(name, MASK_PREDICTORS, "predictor")](horizon, dt)
    own = code.read(name, "predictor")
    made: Predictor = own.make("predictor", horizon, dt)
    if (made.horizon, made.dt, isinstance(made.name, str)) != (horizon, dt, True):
        problem = f"a predictor needs a name, horizon = {horizon} frames and dt = {dt:g} s"
        raise BadInput(problem, file=own.place, field=own.member)
    return made


__all__ = ["PREDICTORS", "KinematicForecast", "Predictor", "make_predictor"]
