"""Every policy by name: the explicit table that `--policy` reads."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial

from cosim.errors import BadInput, hint
from cosim.types import Policy

# policy.agents.approaches has the table; its names alone are needed before torch is
LEARNING = ("vfn-p", "vfn", "vfn-p-egoistic", "safe-dqn", "conv3d-dqn", "conv3d-a2c", "conv2d-dqn")


def _made(module: str, kind: str, *arguments: str) -> Policy:
    """A policy's class by name: its module (torch, compiled kernels) is imported when one is made."""
    made: Policy = getattr(importlib.import_module(f"policy.agents.{module}"), kind)(*arguments)
    return made


POLICIES: dict[str, Callable[[], Policy]] = {
    "idm": partial(_made, "idm", "Idm"),
    "idm-courteous": partial(_made, "idm", "IdmCourteous"),
    "keep-lane": partial(_made, "keep_lane", "KeepLane"),
    "random": partial(_made, "random", "Random"),
    "altruist-rule": partial(_made, "altruist_rule", "AltruistRule"),
    **{name: partial(_made, "prediction_aware", "PredictionAware", name) for name in LEARNING},
}


def check_name(name: str) -> None:
    """Raises BadInput naming the nearest known name."""
    if name not in POLICIES:
        raise BadInput(f"unknown policy{hint(name, POLICIES)}", field="--policy", value=name)


def make(name: str) -> Policy:
    """A fresh policy. Raises BadInput for an unknown name."""
    check_name(name)
    return POLICIES[name]()
