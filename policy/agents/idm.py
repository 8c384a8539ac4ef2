"""AVs that nobody commands: SUMO drives them, egoistic or with its default courtesy."""

from __future__ import annotations

import math
from collections.abc import Mapping

from cosim.types import Decision, History, ObservationConfig, PolicyContext

NO_MAPS = ObservationConfig(maps=False)
# An AV as `idm` (definitions.md, Vehicles):
TIME_GAP, STANDSTILL, ACCEL, COMFORT = 0.8, 2.0, 3.0, 7.0  # s, m, m/s2, m/s2


def wished_gap(speed: float, leader_speed: float, time_gap: float = TIME_GAP) -> float:
    """The gap in m, bumper to bumper, that IDM wishes to its leader (P, section V-A.2); speeds in m/s."""
    closing = speed * (speed - leader_speed) / (2.0 * math.sqrt(ACCEL * COMFORT))
    return STANDSTILL + max(speed * time_gap + closing, 0.0)


class Idm:
    """Egoistic IDM + LC2013 (definitions.md, Vehicles): no cooperation of any kind. The baseline `idm`."""

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
