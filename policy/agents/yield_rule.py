"""A scripted rule that yields to vehicles that need it, on any road, without a mark on any vehicle.

It is the baseline of the learned altruist: whatever learning is worth must show beside it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cosim.types import Decision, History, MetaAction, ObservationConfig, PolicyContext
from policy.agents.idm import Idm
from policy.inputs.conflict import along
from policy.inputs.needs import Need, Needs

# What the AV does; docs/results/yielding.md measures the effect of each
EASES_OFF = True  # behind a vehicle that signals onto its lane
YIELDS_AT_LINES = True  # to a vehicle that has long waited at a line where it gives way to the AV


@dataclass(frozen=True, slots=True)
class Habits:
    """How an AV yields: those of `yield-rule` are set by hand, `cosim train altruist` searches for others."""

    behind: float = 10.0  # m to the rear of a vehicle that signals, where the AV has slowed down for it
    ease: float = 4.0  # m/s below the speed of that vehicle
    braking: float = 2.0  # m/s2, with which the AV slows down on the way there
    slack: float = 1.0  # m/s that the AV may be too fast when it begins
    upstream: float = 80.0  # m before its line, where the AV begins at the latest: nearer, it closes the gap
    crawl: float = 2.0  # m/s, the lowest speed of an AV that lets a vehicle go
    patience: float = 5.0  # s that a vehicle has waited at its line
    queue: float = 0.0  # share of this patience that each vehicle close behind the AV adds
    hold: float = 8.0  # s of yielding in vain at most,
    rest: float = 6.0  # and s without it afterwards


HABITS = Habits()
CLOSE = 60.0  # m behind the AV


class YieldRule(Idm):
    """Accelerates, but slows down for vehicles that signal onto its lane or have long waited."""

    name = "yield-rule"
    observation = ObservationConfig(maps=False, rows=32)
    habits = HABITS

    def reset(self, context: PolicyContext) -> None:
        """Start an episode: nobody has yielded yet."""
        super().reset(context)
        self._needs = Needs(context)
        self._weight = min(math.tan(context.svo), 1.0)  # of others, relative to the AV's own (P, eq. (6))
        self._began: dict[tuple[str, str], float] = {}  # (AV, vehicle) -> s, the begin of yielding
        self._rests: dict[str, float] = {}  # AV -> s, until then it does not begin to yield
        self._serves: set[tuple[str, str, int]] = set()  # AV, vehicle that it lets go, and link over its line

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Accelerate, or the acceleration towards the lowest speed that any need asks for."""
        needs = self._needs.find(histories) if self._weight > 0.0 else {}
        now = max((history.time for history in histories.values()), default=0.0)
        self._began = {
            pair: began
            for pair, began in self._began.items()
            if now - began < self.habits.hold + self.habits.rest
        }
        self._serves = self._chosen(needs, histories, now)
        return {av: self._decision(history, needs.get(av, [])) for av, history in histories.items()}

    def _decision(self, history: History, needs: list[Need]) -> Decision:
        speeds = [self._speed(need) for need in needs if self._yields(history, need)]
        wanted = min(speeds, default=math.inf)
        if wanted > history.ego_speed + self.habits.ease:
            return Decision(MetaAction.ACCELERATE)
        return Decision(MetaAction.IDLE, accel=wanted - history.ego_speed)

    def _chosen(
        self, needs: Mapping[str, list[Need]], histories: Mapping[str, History], now: float
    ) -> set[tuple[str, str, int]]:
        """For each vehicle and each way across it, the nearest AV that can let it go, of those in touch."""
        able: dict[tuple[str, int], list[tuple[bool, float, str]]] = {}
        for av, of in needs.items():
            if now < self._rests.get(av, 0.0):
                continue
            for need in of:
                serves = (av, need.vehicle, need.link) in self._serves and need.gap > 0.0
                if serves or self._can(histories[av], need):
                    able.setdefault((need.vehicle, need.link), []).append((not serves, need.gap, av))
        return {
            (av, *key)
            for key, ranks in able.items()
            for *_, av in ranks
            if av == min(rank for rank in ranks if _in_touch(histories[av], rank[2]))[2]
        }

    def _can(self, history: History, need: Need) -> bool:
        """Whether this AV is far enough away to open a gap."""
        habits = self.habits
        if need.crossing:
            far = YIELDS_AT_LINES and need.gap >= habits.upstream
            return far and need.waited >= self._patience(history)
        return EASES_OFF and need.gap > 0.0 and history.ego_speed <= self._speed(need) + habits.slack

    def _patience(self, history: History) -> float:
        """s that a vehicle must have waited: the longer, the more others would wait behind this AV."""
        own, habits = history.route.paths[1], self.habits
        if not habits.queue or own is None:
            return habits.patience
        ahead = along(history, own)[:, 0]
        return habits.patience * (1.0 + habits.queue * int(((ahead < 0.0) & (ahead > -CLOSE)).sum()))

    def _yields(self, history: History, need: Need) -> bool:
        """Whether the need is this AV's to serve, now, and not in vain for too long."""
        av, now = history.ids[0], history.time
        if (av, need.vehicle, need.link) not in self._serves:
            return False
        began = self._began.get((av, need.vehicle))
        if began is None or need.between:  # nobody can use a gap before those ahead of the AV have passed
            began = now
        self._began[av, need.vehicle] = began
        if now - began > self.habits.hold:
            self._rests[av] = now + self.habits.rest
            del self._began[av, need.vehicle]
            return False
        return True

    def _speed(self, need: Need) -> float:
        """The speed (m/s) that a need asks for: at a line a crawl, else gently down to the other's pace."""
        if need.crossing:
            return self.habits.crawl
        pace = max(need.speed - self.habits.ease * self._weight, self.habits.crawl)
        return math.sqrt(pace**2 + 2.0 * self.habits.braking * max(need.gap - self.habits.behind, 0.0))


def _in_touch(history: History, other: str) -> bool:
    """Whether an AV knows what the other one intends, or is that one."""
    return history.hears is None or other == history.ids[0] or other in history.hears
