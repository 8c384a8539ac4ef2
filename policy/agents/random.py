"""AVs that draw their meta-action at random: the floor every policy must beat."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.types import Decision, History, MetaAction, PolicyContext
from policy.agents.idm import NO_MAPS


class Random:
    """Uniform over the five meta-actions, from the episode's own generator."""

    name = "random"
    label = ""
    observation = NO_MAPS
    av_parameters: Mapping[str, str] = {}

    def reset(self, context: PolicyContext) -> None:
        """Take the episode's generator."""
        self._rng = context.rng

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """One draw per AV, in the order of their ids."""
        return {
            av: Decision(MetaAction(int(self._rng.integers(len(MetaAction))))) for av in sorted(histories)
        }
