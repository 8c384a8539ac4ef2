"""Policies for comparisons in claims (`LABEL=research.policies:NAME`): the safety mask without a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cosim.types import Floats32, History, MetaAction
from policy.agents.approaches import AgentConfig, compact
from policy.agents.prediction_aware import Inputs, PredictionAware
from policy.inputs.tensors import States, svo_tensor


class MaskOnly(PredictionAware):
    """All actions have equal values, without a network or maps.

    An AV keeps lane and speed while that is safe, and speeds up again after slowing down: the prioritizer's
    order of equal values. Without a mask this is `keep-lane`.
    """

    def __init__(self, name: str, config: AgentConfig) -> None:
        super().__init__(name, replace(config, predicted_maps=False, vfn_weights=None))
        self.observation = replace(config.observation, maps=False)
        self.label = ""

    def perceive(self, histories: Mapping[str, History]) -> Inputs:
        """The prioritizer's inputs; those of a network are empty."""
        scene, traffic, _ = self.foresee(histories)
        none = svo_tensor(0.0, 0)
        return Inputs(scene, States(none, none, none, none), traffic)

    def values(self, inputs: Inputs) -> Floats32:
        """[agents, actions] zeros; without a mask 1 for IDLE."""
        q = np.zeros((len(inputs.scene.agents), len(MetaAction)), np.float32)
        if not self.config.mask:
            q[:, MetaAction.IDLE] = 1.0
        return q


class RandomChoice(MaskOnly):
    """All actions are valued at random at every decision."""

    def values(self, inputs: Inputs) -> Floats32:
        """[agents, actions] uniform random numbers."""
        size = len(inputs.scene.agents), len(MetaAction)
        return self._context.rng.random(size, np.float32)


def cruise() -> MaskOnly:
    """Keeps lane and speed behind the mask of `vfn-p`."""
    return MaskOnly("cruise", compact("vfn-p"))


def masked_random() -> RandomChoice:
    """Chooses at random among the actions that the mask of `vfn-p` admits."""
    return RandomChoice("masked-random", compact("vfn-p"))
