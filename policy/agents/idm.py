"""AVs without commands: SUMO drives them, egoistic or with its default courtesy."""

import math
from collections.abc import Mapping

from cosim.types import Decision, History, ObservationConfig, PolicyContext

# IDM parameters of an AV under policy `idm` (presets.md, Policies):
TIME_GAP, STANDSTILL_GAP, ACCEL, COMFORT_DECEL = 0.8, 2.0, 3.0, 7.0  # s, m, m/s2, m/s2


def desired_gap(speed: float, leader_speed: float, time_gap: float = TIME_GAP) -> float:
    """IDM's desired gap to the leader (P, section V-A.2).

    Args:
        speed: of the follower, m/s.
        leader_speed: m/s.
        time_gap: s.

    Returns:
        m, bumper to bumper.
    """
    closing = speed * (speed - leader_speed) / (2.0 * math.sqrt(ACCEL * COMFORT_DECEL))
    return STANDSTILL_GAP + max(speed * time_gap + closing, 0.0)


class Idm:
    """Egoistic IDM + LC2013 without any cooperation (presets.md, Policies). The baseline `idm`.

    Base class of all policies without maps that keep SUMO's parameters.
    """

    name = "idm"
    label = ""
    observation = ObservationConfig(maps=False)
    av_parameters: Mapping[str, str] = {}

    def reset(self, context: PolicyContext) -> None:
        """Start an episode."""
        self.context = context

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """No AV is commanded."""
        return {}


class IdmCourteous(Idm):
    """`idm` with SUMO's default courtesy (lcCooperative = 1 and its speed adaptation)."""

    name = "idm-courteous"
    av_parameters: Mapping[str, str] = {
        "laneChangeModel.lcCooperative": "1",
        "laneChangeModel.lcCooperativeSpeed": "1",
    }


class IdmHeadway(Idm):
    """`idm` with another time gap, s: more careful than 0.8 s, and as egoistic."""

    def __init__(self, time_gap: str) -> None:
        self.name = f"idm-{time_gap}"
        self.av_parameters = {"tau": time_gap}
