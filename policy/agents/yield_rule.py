"""A scripted rule that yields to vehicles that need it, on any road, without a mark on any vehicle.

It is the baseline of the learned altruist: whatever learning is worth must show beside it.
"""

import math
from collections.abc import Mapping

import numpy as np

from cosim.types import HEADING, SPEED, Decision, History, MetaAction, ObservationConfig, PolicyContext, X, Y
from policy.agents.idm import Idm
from policy.inputs.conflict import LEFT, RIGHT, along, is_free
from policy.inputs.needs import Need, Needs

# What the AV does; docs/results/yielding.md measures the effect of each
EASES_OFF = True  # behind a vehicle that signals onto its lane
YIELDS_AT_LINES = True  # to a vehicle that has long waited at a line where it gives way to the AV
MAKES_WAY = False  # changes lanes away from a vehicle that signals onto its lane
ARRIVES_GENTLY = False  # is not much faster than the traffic ahead
OVERTAKES = False  # changes to a faster lane: egoists too

# Set by hand
GAPS = 2.0, 40.0  # m to the other's rear, at least and at most: an AV nearer would stand beside it
EASE = 4.0  # m/s below its speed
HOLD, REST = 8.0, 6.0  # s of yielding at most, and then without it
PATIENCE = 5.0  # s that a vehicle has waited at its line
HOLD_AT_LINE = 60.0  # s of yielding at a line at most
UPSTREAM = 80.0  # m before its line, where the AV begins at the latest: nearer, it would close the gap itself
CRAWL = 2.0  # m/s, of the AV while it lets a vehicle go
SURPLUS = 4.0  # m/s above the mean speed of the traffic ahead
STRETCH, SIDE, LEAST_AHEAD = (20.0, 120.0), 8.0, 3  # m ahead and aside, and vehicles, of this mean
SAME_WAY = 0.5  # rad, the largest difference of their headings to the AV's
GAIN, NEAR = 3.0, 80.0  # m/s that the other lane is faster, and m ahead that count
SETTLE = 10.0  # s between two lane changes


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
        self._guides: dict[tuple[str, int], str] = {}  # (waiting vehicle, link) -> the AV that lets it go
        self._changes: dict[str, float] = {}  # AV -> s, until then it does not change lanes

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Accelerate, or the acceleration towards the lowest speed that any need asks for."""
        needs = self._needs.find(histories) if self._weight > 0.0 else {}
        now = max((history.time for history in histories.values()), default=0.0)
        self._began = {
            pair: began for pair, began in self._began.items() if now - began < HOLD_AT_LINE + REST
        }
        self._guides = self._chosen(histories, needs)
        return {av: self._decision(history, needs.get(av, [])) for av, history in histories.items()}

    def _decision(self, history: History, needs: list[Need]) -> Decision:
        speeds = [self._speed(history, need) for need in needs if self._yields(history, need)]
        if ARRIVES_GENTLY and self._weight > 0.0:
            speeds.append(_mean_ahead(history) + SURPLUS)
        wanted = min(speeds, default=math.inf)
        accel = wanted - history.ego_speed if wanted <= history.ego_speed + EASE else None
        change = self._change(history, needs)
        if change is None:
            change = MetaAction.ACCELERATE if accel is None else MetaAction.IDLE
        return Decision(change, accel=accel)

    def _chosen(
        self, histories: Mapping[str, History], needs: Mapping[str, list[Need]]
    ) -> dict[tuple[str, int], str]:
        """For each waiting vehicle and each way across it, the AV that lets it go: the nearest that can."""
        found: dict[tuple[str, int], tuple[bool, float, str]] = {}
        for av, of in needs.items():
            for need in of:
                key = need.vehicle, need.link
                held = self._guides.get(key) == av
                begins = need.crossing and need.waited >= PATIENCE and need.gap >= UPSTREAM
                if held or begins:
                    found[key] = min(found.get(key, (True, math.inf, av)), (not held, need.gap, av))
        return {key: av for key, (_, _, av) in found.items()}

    def _yields(self, history: History, need: Need) -> bool:
        """Whether the need is this AV's to serve, now, and not for too long."""
        av, now = history.ids[0], history.time
        if need.crossing:
            fits = YIELDS_AT_LINES and self._guides.get((need.vehicle, need.link)) == av
        else:
            fits = EASES_OFF and not need.between and GAPS[0] <= need.gap <= GAPS[1]
        began = self._began.get((av, need.vehicle))
        if not fits or (began is None and now < self._rests.get(av, 0.0)):
            return False
        began = self._began.setdefault((av, need.vehicle), now)
        if now - began > (HOLD_AT_LINE if need.crossing else HOLD):
            self._rests[av] = now + REST
            del self._began[av, need.vehicle]
            return False
        return True

    def _speed(self, history: History, need: Need) -> float:
        """The speed (m/s) that a need asks for."""
        return CRAWL if need.crossing else max(need.speed - EASE * self._weight, 0.0)

    def _change(self, history: History, needs: list[Need]) -> MetaAction | None:
        """A lane change that makes way, or gains speed; None without one."""
        av, now = history.ids[0], history.time
        if now < self._changes.get(av, 0.0):
            return None
        for side, action in ((LEFT, MetaAction.LANE_LEFT), (RIGHT, MetaAction.LANE_RIGHT)):
            leaves = MAKES_WAY and any(_is_left_for(side, need) for need in needs)
            gains = OVERTAKES and _speed_ahead(history, side) > _speed_ahead(history, 1) + GAIN
            if (leaves or gains) and is_free(history, side):
                self._changes[av] = now + SETTLE
                return action
        return None


def _is_left_for(side: int, need: Need) -> bool:
    """Whether the vehicle is just ahead and signals from the other side than this one (`LEFT`, `RIGHT`)."""
    return not need.crossing and need.from_right == (side == LEFT) and 0.0 <= need.gap <= GAPS[1]


def _speed_ahead(history: History, side: int) -> float:
    """The lowest speed (m/s) of the vehicles just ahead on a lane, at most the limit; 0 without a lane."""
    path = history.route.paths[side]
    if path is None:
        return 0.0
    speeds = [speed for ahead, speed in along(history, path) if 0.0 < ahead < NEAR]
    return float(min([*speeds, history.route.speed_limit]))


def _mean_ahead(history: History) -> float:
    """The mean speed (m/s) of the vehicles ahead on all lanes of this direction; inf of too few."""
    newest = history.kinematics[-1]
    ahead = history.valid[-1] & (newest[:, X] > STRETCH[0]) & (newest[:, X] < STRETCH[1])
    ahead &= (np.abs(newest[:, Y]) < SIDE) & (np.abs(newest[:, HEADING]) < SAME_WAY)
    return float(newest[ahead, SPEED].mean()) if ahead.sum() >= LEAST_AHEAD else math.inf
