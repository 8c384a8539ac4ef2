"""AVs with random meta-actions: the lower bound for every policy."""

from collections.abc import Mapping

from cosim.types import Decision, History, MetaAction
from policy.agents.idm import Idm


class Random(Idm):
    """Uniform over the five meta-actions, from the episode's own generator."""

    name = "random"

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """One draw per AV, in the order of their ids."""
        draw = self.context.rng.integers
        return {av: Decision(MetaAction(int(draw(len(MetaAction))))) for av in sorted(histories)}
