"""Every policy by name: the explicit tables that `--policy` reads; they need no torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from cosim.errors import BadInput, hint
from cosim.types import Policy


@dataclass(frozen=True, slots=True)
class Approach:
    """One row of definitions.md's table of approaches."""

    extractor: Literal["conv3d", "conv2d"] = "conv3d"
    kinematics: bool = True  # K and the route join the maps
    predicted_maps: bool = True
    mask: Literal["gp-indirect", "cs", "none"] = "gp-indirect"
    learning: Literal["ddqn", "a2c"] = "ddqn"


APPROACHES = {
    "vfn-p": Approach(),
    "vfn-p-egoistic": Approach(),  # the twin: the same agent, trained with phi = 0
    "vfn": Approach(predicted_maps=False, mask="cs"),
    "safe-dqn": Approach(kinematics=False, predicted_maps=False, mask="cs"),
    "conv3d-dqn": Approach(kinematics=False, predicted_maps=False, mask="none"),
    "conv3d-a2c": Approach(kinematics=False, predicted_maps=False, mask="none", learning="a2c"),
    "conv2d-dqn": Approach("conv2d", kinematics=False, predicted_maps=False, mask="none"),
}


def _prediction_aware(name: str) -> Callable[[], Policy]:
    def build() -> Policy:
        from policy.agents.prediction_aware import PredictionAware  # torch: only when it is asked for

        return PredictionAware(name)

    return build


def _rules() -> dict[str, Callable[[], Policy]]:
    from policy.agents.altruist_rule import AltruistRule
    from policy.agents.idm import Idm, IdmCourteous
    from policy.agents.keep_lane import KeepLane
    from policy.agents.random import Random

    return {c.name: c for c in (Idm, IdmCourteous, KeepLane, Random, AltruistRule)}


POLICIES: dict[str, Callable[[], Policy]] = {
    **_rules(),
    **{name: _prediction_aware(name) for name in APPROACHES},
}


def check_name(name: str) -> None:
    """Raises BadInput naming the nearest known name."""
    if name not in POLICIES:
        raise BadInput(f"unknown policy{hint(name, POLICIES)}", field="--policy", value=name)


def make(name: str) -> Policy:
    """A fresh policy. Raises BadInput for an unknown name."""
    check_name(name)
    return POLICIES[name]()
