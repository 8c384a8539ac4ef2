"""AVs that keep lane and speed without a safety check: a measure of how hard the traffic is."""

from collections.abc import Mapping

from cosim.types import Decision, History, MetaAction
from policy.agents.idm import Idm


class KeepLane(Idm):
    """Always Idle. Its crash rate, reported beside C%, shows the difficulty of the scenario."""

    name = "keep-lane"

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Idle for every AV."""
        return dict.fromkeys(histories, Decision(MetaAction.IDLE))
