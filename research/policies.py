"""Policies that claims alone compare (`LABEL=research.policies:NAME`): the mask without a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cosim.types import Floats32, History, MetaAction
from policy.agents.approaches import AgentConfig, compact
from policy.agents.prediction_aware import Inputs, PredictionAware
from policy.inputs.tensors import States, svo_tensor


class MaskOnly(PredictionAware):
    """All actions are worth the same: an AV keeps lane and speed while that is safe, and picks up speed when
    it has become slow (the prioritizer's order of equal values). Without a mask this is `keep-lane`.

    No network is asked, no map drawn.
    """

    def __init__(self, name: str, config: AgentConfig) -> None:
        super().__init__(name, replace(config, predicted_maps=False, vfn_weights=None))
        self.observation = replace(config.observation, maps=False)
        self.label = ""

    def perceive(self, histories: Mapping[str, History]) -> Inputs:
        """What the prioritizer needs."""
        scene, traffic, _ = self.foresee(histories)
        none = svo_tensor(0.0, 0)
        return Inputs(scene, States(none, none, none, none), traffic)

    def values(self, inputs: Inputs) -> Floats32:
        """All alike."""
        q = np.zeros((len(inputs.scene.agents), len(MetaAction)), np.float32)
        if not self.config.mask:
            q[:, MetaAction.IDLE] = 1.0
        return q


def cruise() -> MaskOnly:
    """Keeps lane and speed behind the mask of `vfn-p`."""
    return MaskOnly("cruise", compact("vfn-p"))
