"""The scripted driver that shows a learner what a gap brings: guided episodes of the training."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cosim.types import Floats32, History, MetaAction, PolicyContext
from policy.agents.altruist_rule import AltruistRule

YIELD = 2.0  # his preference for what the scripted altruist commands: above all others
BEHIND = 3.0  # m/s that the speed may lag behind its target before the target is raised further
CRUISE = {
    MetaAction.IDLE: 0.8,
    MetaAction.DECELERATE: 0.6,
    MetaAction.LANE_LEFT: 0.4,
    MetaAction.LANE_RIGHT: 0.2,
}


class Mentor:
    """What `AltruistRule` commands where it commands, else up to the speed limit as fast as the mask allows.

    An egoist (phi = 0) has a mentor too, who only cruises.
    """

    def __init__(self) -> None:
        self._rule = AltruistRule()

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        self._rule.reset(context)
        self._road, self._yields = context.road, context.svo > 0.0

    def preferences(self, histories: Mapping[str, History]) -> Floats32:
        """[B,A] in the order of `histories`: the largest is what it would do; the mask still guards it."""
        yielding = self._rule.decide(histories) if self._yields else {}
        q = np.zeros((len(histories), len(MetaAction)), np.float32)
        for row, (av, history) in zip(q, histories.items(), strict=True):
            row[list(CRUISE)] = list(CRUISE.values())
            lane = int(history.lane[0])
            limit = self._road.lanes[lane].speed_limit if lane >= 0 else 0.0
            slower = history.target_speed < limit - 0.1
            if slower and history.ego_speed > history.target_speed - BEHIND:
                row[MetaAction.ACCELERATE] = 1.0
            if av in yielding:
                row[yielding[av].action] = YIELD
        return q
