"""AVs that always ask for more speed: with preset `lawful` all else is what the car does by itself."""

from collections.abc import Mapping

from cosim.types import Decision, History, MetaAction
from policy.agents.idm import Idm


class CarAlone(Idm):
    """Always Accelerate. What an agent adds to its car is the difference to this."""

    name = "car-alone"

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Accelerate for every AV."""
        return dict.fromkeys(histories, Decision(MetaAction.ACCELERATE))
