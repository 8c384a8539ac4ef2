"""A scripted rule that yields to vehicles that need it, on any road, without a mark on any vehicle.

It is the baseline of the learned altruist: whatever learning is worth must show beside it.
"""

import math
from collections.abc import Mapping

from cosim.types import Decision, History, MetaAction, ObservationConfig, PolicyContext
from policy.agents.idm import Idm
from policy.inputs.needs import Need, Needs

# What the AV does; docs/results/yielding.md measures the effect of each
EASES_OFF = True  # behind a vehicle that signals onto its lane
YIELDS_AT_LINES = True  # to a vehicle that has long waited at a line where it gives way to the AV

# Set by hand
GAPS = 2.0, 40.0  # m to the other's rear, at least and at most: an AV nearer would stand beside it
EASE = 4.0  # m/s below its speed
HOLD, REST = 8.0, 6.0  # s of yielding in vain at most, and then without it
PATIENCE = 5.0  # s that a vehicle has waited at its line
UPSTREAM = 80.0  # m before its line, where the AV begins at the latest: nearer, it would close the gap itself
CRAWL = 2.0  # m/s, of the AV while it lets a vehicle go


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

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Accelerate, or the acceleration towards the lowest speed that any need asks for."""
        needs = self._needs.find(histories) if self._weight > 0.0 else {}
        now = max((history.time for history in histories.values()), default=0.0)
        self._began = {pair: began for pair, began in self._began.items() if now - began < HOLD + REST}
        self._guides = self._chosen(needs, now)
        return {av: self._decision(history, needs.get(av, [])) for av, history in histories.items()}

    def _decision(self, history: History, needs: list[Need]) -> Decision:
        speeds = [self._speed(history, need) for need in needs if self._yields(history, need)]
        wanted = min(speeds, default=math.inf)
        if wanted > history.ego_speed + EASE:
            return Decision(MetaAction.ACCELERATE)
        return Decision(MetaAction.IDLE, accel=wanted - history.ego_speed)

    def _chosen(self, needs: Mapping[str, list[Need]], now: float) -> dict[tuple[str, int], str]:
        """For each waiting vehicle and each way across it, the AV that lets it go: the nearest that can."""
        found: dict[tuple[str, int], tuple[bool, float, str]] = {}
        for av, of in needs.items():
            if now < self._rests.get(av, 0.0):
                continue
            for need in of:
                key = need.vehicle, need.link
                held = self._guides.get(key) == av
                begins = need.crossing and need.waited >= PATIENCE and need.gap >= UPSTREAM
                if held or begins:
                    found[key] = min(found.get(key, (True, math.inf, av)), (not held, need.gap, av))
        return {key: av for key, (_, _, av) in found.items()}

    def _yields(self, history: History, need: Need) -> bool:
        """Whether the need is this AV's to serve, now, and not in vain for too long."""
        av, now = history.ids[0], history.time
        if need.crossing:
            fits = YIELDS_AT_LINES and self._guides.get((need.vehicle, need.link)) == av
        else:
            fits = EASES_OFF and not need.between and GAPS[0] <= need.gap <= GAPS[1]
        began = self._began.get((av, need.vehicle))
        if not fits or (began is None and now < self._rests.get(av, 0.0)):
            return False
        if began is None or need.between:  # nobody can use a gap before those ahead of the AV have passed
            began = now
        self._began[av, need.vehicle] = began
        if now - began > HOLD:
            self._rests[av] = now + REST
            del self._began[av, need.vehicle]
            return False
        return True

    def _speed(self, history: History, need: Need) -> float:
        """The speed (m/s) that a need asks for."""
        return CRAWL if need.crossing else max(need.speed - EASE * self._weight, 0.0)
