"""Kinematic predictors: name -> class."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from cosim.errors import BadInput
from policy.forecast import KinematicForecast
from policy.predictors.constant import ConstantAcceleration, ConstantSpeed
from policy.predictors.gp import GaussianProcessDirect, GaussianProcessIndirect
from policy.predictors.learned import Learned, NetConfig
from policy.predictors.protocol import Predictor

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


def make_predictor(name: str, horizon: int, dt: float) -> Predictor:
    """A predictor `horizon` frames of `dt` s ahead. Raises BadInput for an unknown name."""
    if name not in PREDICTORS:
        raise BadInput(f"unknown predictor (one of {', '.join(PREDICTORS)})", field="predictor", value=name)
    return PREDICTORS[name](horizon, dt)


__all__ = ["PREDICTORS", "KinematicForecast", "Predictor", "make_predictor"]
