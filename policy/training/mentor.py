"""The scripted driver that shows a learner what a gap brings: guided episodes of the training."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cosim.types import Floats32, History, MetaAction, PolicyContext
from policy.agents.altruist_rule import AltruistRule, along

YIELD = 2.0  # his preference for what the scripted altruist commands: above all others
# He follows by IDM, as AVs that SUMO drives do (contract.md, Vehicles), in steps that the 5 m/s grid allows:
TIME_GAP, STANDSTILL, ACCEL, COMFORT = 0.8, 2.0, 3.0, 7.0  # s, m, m/s2, m/s2
CAR = 5.0  # m, between the centres of two cars that touch
AHEAD = 1.0  # s, over which he asks IDM where the speed is going
EAGER = 5.0  # m/s by which he wishes to drive faster than he may: IDM alone creeps up to its desired speed
UP, DOWN = 2.2, 2.6  # m/s between that speed and the target before he goes a level up or down
CRUISE = {
    MetaAction.IDLE: 0.8,
    MetaAction.DECELERATE: 0.6,
    MetaAction.LANE_LEFT: 0.4,
    MetaAction.LANE_RIGHT: 0.2,
}


class Mentor:
    """What `AltruistRule` commands where it commands; else the speed limit, or IDM behind a leader.

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
            row[self._cruise(history)] = 1.0
            if av in yielding:
                row[yielding[av].action] = YIELD
        return q

    def _cruise(self, history: History) -> MetaAction:
        """The grid step towards the speed that IDM would have soon."""
        lane, speed, target = int(history.lane[0]), history.ego_speed, history.target_speed
        limit = max(self._road.lanes[lane].speed_limit, 1.0) if lane >= 0 else max(speed, 1.0)
        own, press = history.route.paths[1], 0.0  # IDM's interaction term
        leaders = [] if own is None else [(x, v) for x, v in along(history, own) if x > 0.0]
        if leaders:
            ahead, other = min(leaders)
            closing = speed * (speed - other) / (2.0 * (ACCEL * COMFORT) ** 0.5)
            wish = STANDSTILL + max(speed * TIME_GAP + closing, 0.0)
            press = (wish / max(ahead - CAR, 0.5)) ** 2
        soon = min(max(speed + AHEAD * ACCEL * (1.0 - (speed / (limit + EAGER)) ** 4 - press), 0.0), limit)
        if soon > target + UP:
            return MetaAction.ACCELERATE
        return MetaAction.DECELERATE if soon < target - DOWN else MetaAction.IDLE
