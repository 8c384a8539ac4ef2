"""A scripted rule that yields to vehicles that need it, on any road, without a mark on any vehicle.

It is the baseline of the learned altruist: whatever learning is worth must show beside it.
"""

import math
from collections.abc import Mapping

import numpy as np

from cosim.control import APPROACH_DECEL
from cosim.types import HEADING, SPEED, Decision, History, MetaAction, ObservationConfig, PolicyContext, X, Y
from policy.agents.idm import Idm
from policy.inputs.needs import Need, Needs

# When an AV yields and how much, set by hand; docs/results/yielding.md compares other values
GAPS = 2.0, 40.0  # m to its rear, at least and at most: an AV nearer would stand beside it
MAX_BETWEEN = 0  # vehicles between both
EASE = 4.0  # m/s below its speed
LEAST_SPEED = 0.0  # m/s, of a vehicle that signals: where traffic crawls, vehicles merge in turn anyway
PATIENCE = 5.0  # s that a vehicle has waited at its line before an AV with priority yields
ARRIVAL = 8.0  # s until the AV's own arrival at the line, at least
HOLD, REST = 8.0, 6.0  # s of yielding at most, and then without it
SURPLUS = float("inf")  # m/s above the mean speed ahead, at most: a gentle arrival at a queue
STRETCH, SIDE, LEAST_AHEAD = (20.0, 120.0), 8.0, 3  # m ahead and aside, and vehicles, of this mean
SAME_WAY = 0.5  # rad, the largest difference of their headings to the AV's


class YieldRule(Idm):
    """Accelerates, but eases off for vehicles that signal onto its lane or have long waited."""

    name = "yield-rule"
    observation = ObservationConfig(maps=False, rows=32)

    def reset(self, context: PolicyContext) -> None:
        """Start an episode: nobody has yielded yet."""
        super().reset(context)
        self._needs = Needs(context)
        self._weight = min(math.tan(context.svo), 1.0)  # of others, as in the lawful car's courtesy
        self._began: dict[tuple[str, str], float] = {}  # (AV, vehicle) -> s, the begin of yielding
        self._rests: dict[str, float] = {}  # AV -> s, until then it does not begin to yield

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Accelerate, or the acceleration towards the lowest speed that any need asks for."""
        if self._weight <= 0.0:
            return dict.fromkeys(histories, Decision(MetaAction.ACCELERATE))
        needs = self._needs.find(histories)
        return {av: self._decision(history, needs.get(av, [])) for av, history in histories.items()}

    def _decision(self, history: History, needs: list[Need]) -> Decision:
        speeds = [self._speed(history, need) for need in needs if self._yields(history, need)]
        wanted = min((*speeds, _mean_ahead(history) + SURPLUS))
        if wanted > history.ego_speed + EASE:
            return Decision(MetaAction.ACCELERATE)
        return Decision(MetaAction.IDLE, accel=wanted - history.ego_speed)

    def _yields(self, history: History, need: Need) -> bool:
        """Whether the need is this AV's to serve, now, and not for too long."""
        av, now = history.ids[0], history.time
        if need.crossing:
            can_slow = history.ego_speed**2 < 2.0 * APPROACH_DECEL * need.gap
            fits = can_slow and need.waited >= PATIENCE
        else:
            fits = (
                need.between <= MAX_BETWEEN and need.speed >= LEAST_SPEED and GAPS[0] <= need.gap <= GAPS[1]
            )
        began = self._began.get((av, need.vehicle))
        if not fits or (began is None and now < self._rests.get(av, 0.0)):
            return False
        began = self._began.setdefault((av, need.vehicle), now)
        if now - began > HOLD:
            self._rests[av] = now + REST
            del self._began[av, need.vehicle]
            return False
        return True

    def _speed(self, history: History, need: Need) -> float:
        """The speed (m/s) that a need asks for."""
        return need.gap / ARRIVAL if need.crossing else max(need.speed - EASE * self._weight, 0.0)


def _mean_ahead(history: History) -> float:
    """The mean speed (m/s) of the vehicles ahead on all lanes of this direction; inf of too few."""
    newest = history.kinematics[-1]
    ahead = history.valid[-1] & (newest[:, X] > STRETCH[0]) & (newest[:, X] < STRETCH[1])
    ahead &= (np.abs(newest[:, Y]) < SIDE) & (np.abs(newest[:, HEADING]) < SAME_WAY)
    return float(newest[ahead, SPEED].mean()) if ahead.sum() >= LEAST_AHEAD else math.inf
