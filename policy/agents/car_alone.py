"""AVs that always accelerate: with preset `lawful` the car controller alone does the rest."""

from collections.abc import Mapping

from cosim.types import Decision, History, MetaAction
from policy.agents.idm import Idm


class CarAlone(Idm):
    """Always Accelerate. An agent's contribution is its difference from this baseline."""

    name = "car-alone"

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Accelerate for every AV."""
        return dict.fromkeys(histories, Decision(MetaAction.ACCELERATE))
