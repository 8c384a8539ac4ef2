"""The prioritizer alone: an agent without a network, to which every action is worth the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from cosim.types import Floats32, History, MetaAction, PolicyContext
from policy.agents.approaches import AgentConfig
from policy.agents.prediction_aware import Inputs, PredictionAware
from policy.inputs.tensors import States


class Unled(PredictionAware):
    """Where all actions are worth the same, it keeps lane and speed while that is safe and picks up speed
    when it has become slow (the prioritizer's order of equal values); without a mask it is then `keep-lane`.
    No network is asked, no map drawn."""

    def __init__(self, name: str, config: AgentConfig, share_intentions: bool = True) -> None:
        super().__init__(name, replace(config, predicted_maps=False, vfn_weights=None))
        self.observation = replace(config.observation, maps=False)
        self.label = ""
        self._share_intentions = share_intentions

    def reset(self, context: PolicyContext) -> None:
        """As the agent's."""
        super().reset(replace(context, share_intentions=context.share_intentions and self._share_intentions))

    def perceive(self, histories: Mapping[str, History]) -> Inputs:
        """What the prioritizer needs."""
        scene, traffic, _ = self.foresee(histories)
        none = torch.empty(0)
        return Inputs(scene, States(none, none, none, none), traffic)

    def values(self, inputs: Inputs) -> Floats32:
        """All alike."""
        q = np.zeros((len(inputs.scene.agents), len(MetaAction)), np.float32)
        if not self.config.mask:
            q[:, MetaAction.IDLE] = 1.0
        return q
