"""AVs that nobody commands: SUMO drives them, egoistic or with its default courtesy."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.types import Decision, History, ObservationConfig, PolicyContext

NO_MAPS = ObservationConfig(maps=False)


class Idm:
    """Egoistic IDM + LC2013 (contract.md, Vehicles): no cooperation of any kind. The baseline `idm`."""

    name = "idm"
    label = ""
    observation = NO_MAPS
    av_parameters: Mapping[str, str] = {}

    def reset(self, context: PolicyContext) -> None:
        """Nothing to remember."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Nobody is commanded."""
        return {}


class IdmCourteous(Idm):
    """The same with SUMO's own default courtesy (lcCooperative = 1 and its speed adaptation)."""

    name = "idm-courteous"
    av_parameters: Mapping[str, str] = {
        "laneChangeModel.lcCooperative": "1",
        "laneChangeModel.lcCooperativeSpeed": "1",
    }
