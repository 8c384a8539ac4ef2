"""Every policy by name: the explicit tables that `--policy` reads; they need no torch."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from cosim.errors import BadInput, hint
from cosim.types import Policy


@dataclass(frozen=True, slots=True)
class Approach:
    """One row of paper_map.md's table of approaches."""

    extractor: Literal["conv3d", "conv2d"] = "conv3d"
    kinematics: bool = True  # K and the route join the maps
    predicted_maps: bool = True
    mask: Literal["gp-indirect", "hold", "none"] = "gp-indirect"
    learning: Literal["ddqn", "a2c"] = "ddqn"


APPROACHES = {
    "vfn-p": Approach(),
    "vfn": Approach(predicted_maps=False, mask="hold"),
    "safe-dqn": Approach(kinematics=False, predicted_maps=False, mask="hold"),
    "conv3d-dqn": Approach(kinematics=False, predicted_maps=False, mask="none"),
    "conv3d-a2c": Approach(kinematics=False, predicted_maps=False, mask="none", learning="a2c"),
    "conv2d-dqn": Approach("conv2d", kinematics=False, predicted_maps=False, mask="none"),
}
TRAINABLE = ("vfn-p", "vfn", "safe-dqn", "conv3d-dqn", "conv3d-a2c", "conv2d-dqn")  # cosim train NAME


def _made(module: str, kind: str, *arguments: str) -> Policy:
    """A policy by class name. Its module (torch, compiled kernels) is imported on construction only."""
    made: Policy = getattr(importlib.import_module(f"policy.agents.{module}"), kind)(*arguments)
    return made


POLICIES: dict[str, Callable[[], Policy]] = {
    "idm": partial(_made, "idm", "Idm"),
    **{f"idm-{gap}": partial(_made, "idm", "IdmHeadway", gap) for gap in ("1.5", "2.2")},  # time gap, s
    "idm-courteous": partial(_made, "idm", "IdmCourteous"),
    "keep-lane": partial(_made, "keep_lane", "KeepLane"),
    "car-alone": partial(_made, "car_alone", "CarAlone"),
    "random": partial(_made, "random", "Random"),
    "altruist-rule": partial(_made, "altruist_rule", "AltruistRule"),
    "yield-rule": partial(_made, "yield_rule", "YieldRule"),
    **{name: partial(_made, "prediction_aware", "PredictionAware", name) for name in APPROACHES},
    "vfn-p-oracle": partial(_made, "oracle", "Oracle", "vfn-p"),  # predicts from counterfactual rollouts
}


def check_name(name: str) -> None:
    """Raises BadInput naming the nearest known name."""
    if name not in POLICIES:
        raise BadInput(f"unknown policy{hint(name, POLICIES)}", field="--policy", value=name)


def make(name: str) -> Policy:
    """A fresh policy. Raises BadInput for an unknown name."""
    check_name(name)
    return POLICIES[name]()
