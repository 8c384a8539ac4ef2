"""Every policy by name: the explicit table that `--policy` reads."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from cosim.errors import BadInput, hint
from cosim.types import Policy
from policy.agents.altruist_rule import AltruistRule
from policy.agents.idm import Idm, IdmCourteous
from policy.agents.keep_lane import KeepLane
from policy.agents.random import Random

# policy.agents.approaches has the table; its names alone are needed before torch is
LEARNING = ("vfn-p", "vfn", "vfn-p-egoistic", "safe-dqn", "conv3d-dqn", "conv3d-a2c", "conv2d-dqn")


def _prediction_aware(name: str) -> Policy:
    from policy.agents.prediction_aware import PredictionAware  # torch: only when it is asked for

    return PredictionAware(name)


POLICIES: dict[str, Callable[[], Policy]] = {
    **{policy.name: policy for policy in (Idm, IdmCourteous, KeepLane, Random, AltruistRule)},
    **{name: partial(_prediction_aware, name) for name in LEARNING},
}


def check_name(name: str) -> None:
    """Raises BadInput naming the nearest known name."""
    if name not in POLICIES:
        raise BadInput(f"unknown policy{hint(name, POLICIES)}", field="--policy", value=name)


def make(name: str) -> Policy:
    """A fresh policy. Raises BadInput for an unknown name."""
    check_name(name)
    return POLICIES[name]()
