"""AVs that hold their lane and speed: with nobody guarding them, how hard is the traffic?"""

from __future__ import annotations

from collections.abc import Mapping

from cosim.types import Decision, History, MetaAction, PolicyContext
from policy.agents.idm import NO_MAPS


class KeepLane:
    """Always Idle. Its crash rate stands beside C% so that the difficulty can be seen (definitions.md)."""

    name = "keep-lane"
    label = ""
    observation = NO_MAPS
    av_parameters: Mapping[str, str] = {}

    def reset(self, context: PolicyContext) -> None:
        """Nothing to remember."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Idle for every AV."""
        return dict.fromkeys(histories, Decision(MetaAction.IDLE))
