"""The scripted driver whose actions a learner imitates: the demonstrator of guided episodes."""

from collections.abc import Mapping

import numpy as np

from cosim.control import MAX_DECEL, TIME_CONSTANT, next_target, tracked_speeds
from cosim.types import Floats, Floats32, History, MetaAction, PolicyContext
from policy.agents.altruist_rule import AltruistRule
from policy.agents.idm import ACCEL, desired_gap
from policy.inputs.meeting import CAR, along

YIELD = 2.0  # preference for what the scripted altruist commands: all others are below 0
TIME_GAP = 1.0  # s: IDM with a little more than its time gap, which avoids harsh steps
EAGER = 5.0  # m/s above the limit as the desired speed: IDM alone nears its desired speed slowly
AHEAD = 0.4  # s, over which an action's acceleration is compared with IDM's
HARD = 3.0  # m/s2: a braking that begins harder than this, and than IDM wishes, costs
HARSH = 10.0  # m/s2 of misfit
AS_GOOD = 1.0  # m/s2 of misfit more than the best action's, with which another is as good
NEVER = -20.0  # m/s2: lane changes only to yield
LONGITUDINAL = (MetaAction.IDLE, MetaAction.ACCELERATE, MetaAction.DECELERATE)
APPARENT = (0.0, 1.4, -2.0)  # m/s2 these stand for where the commanded speed is not known


class Demonstrator:
    """What `AltruistRule` commands where it commands; else the speed limit, or IDM behind a leader.

    For an egoist (phi = 0) it only cruises. A learner that sees maps alone cannot tell an AV that is braking
    already (Idle will do) from one that is not: there the commanded speed is not looked at.

    Args:
        knows_command: whether the learner's inputs hold the commanded speed.
    """

    def __init__(self, knows_command: bool = True) -> None:
        self._rule = AltruistRule()
        self._fits = self._by_command if knows_command else self._by_appearance

    def reset(self, context: PolicyContext) -> None:
        """A new episode."""
        self._rule.reset(context)
        self._road, self._yields = context.road, context.svo > 0.0

    def preferences(self, histories: Mapping[str, History]) -> Floats32:
        """[B,A] in the order of `histories`: the largest is what it would do, mask apart."""
        yielding = self._rule.decide(histories) if self._yields else {}
        q = np.empty((len(histories), len(MetaAction)), np.float32)
        for row, (av, history) in zip(q, histories.items(), strict=True):
            row[:] = self._cruise(history)
            if av in yielding:
                row[yielding[av].action] = YIELD
        return q

    def _cruise(self, history: History) -> Floats32:
        """How well each longitudinal action fits IDM's wish: minus the difference in acceleration, m/s2."""
        lane, speed, target = int(history.lane[0]), history.ego_speed, history.target_speed
        limit = max(self._road.lanes[lane].speed_limit, 1.0) if lane >= 0 else max(speed, 1.0)
        own, press = history.route.paths[1], 0.0  # IDM's interaction term
        leaders = [] if own is None else [(x, v) for x, v in along(history, own) if x > 0.0]
        if leaders:
            ahead, other = min(leaders)
            press = (desired_gap(speed, other, TIME_GAP) / max(ahead - CAR, 0.5)) ** 2
        free = 1.0 - (speed / (limit + EAGER)) ** 4
        fits = np.full(len(MetaAction), NEVER, np.float32)
        fits[list(LONGITUDINAL)] = self._fits(ACCEL * (free - press), speed, target, limit)
        return fits

    @staticmethod
    def _by_command(wished: float, speed: float, target: float, limit: float) -> Floats:
        """[3] m/s2 of LONGITUDINAL, by what each would make of the commanded speed `target` within AHEAD."""
        wished = min(max(wished, -speed, -MAX_DECEL), limit - speed)
        sought = np.array([next_target(target, speed, action, limit) for action in LONGITUDINAL])
        got = (tracked_speeds(speed, sought, 1, AHEAD)[:, 1] - speed) / AHEAD
        onset = np.maximum((sought - speed) / TIME_CONSTANT, -MAX_DECEL)
        harsh = (onset < -HARD) & (onset < wished)
        return np.asarray(-np.abs(got - wished) - HARSH * harsh)

    @staticmethod
    def _by_appearance(wished: float, *_: float) -> Floats:
        """[3] m/s2 of LONGITUDINAL: faster, slower or neither, whatever is commanded."""
        return np.asarray(-np.abs(np.array(APPARENT) - wished))
