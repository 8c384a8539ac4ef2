"""A scripted altruist: the best placed AV (the guide) opens a gap for the mission vehicle, others drive IDM.

The rule shows the gain of altruism without learning (research/claims/altruism.yaml) and is the baseline of
the learned policies. AVs share their observations (V2V), so they agree on one guide per mission vehicle.
"""

from collections.abc import Mapping
from typing import NamedTuple

from cosim.types import Decision, History, MetaAction, PolicyContext
from policy.agents.idm import Idm, desired_gap
from policy.inputs.conflict import (
    CAR_LENGTH,
    LEFT,
    Conflict,
    Seen,
    along,
    find_conflict,
    is_free,
    missions,
)

# When the guide yields and how much; m, m/s
MIN_LAG = -5.0  # a guide at most 5 m ahead of the mission vehicle can still fall back
MAX_LAG = 80.0  # a guide further back would open the gap too late
MIN_UPSTREAM = 60.0  # junctions: the gap must open upstream, not at the stop line
MAX_UPSTREAM = 260.0
CRAWL_SPEED = 2.0  # target speed of the guide upstream of a junction (on the grid: 0)
PACE_SPEED_OFFSET = 5.0  # beside an ending lane: guide's speed below the mission vehicle's
MIN_PACE_SPEED = 5.0  # lowest speed of the guide there


class Need(NamedTuple):
    """One AV's conflict with the mission vehicle."""

    av: str
    conflict: Conflict


class AltruistRule(Idm):
    """The guide changes to a free left lane, else slows down; at junctions it slows down far upstream."""

    name = "altruist-rule"

    def reset(self, context: PolicyContext) -> None:
        """Start an episode: no mission vehicle has merged yet."""
        super().reset(context)
        self._served: set[str] = set()
        self._guide: dict[str, Need] = {}  # mission vehicle -> its guide

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """At most one command per mission vehicle, to its guide."""
        decisions: dict[str, Decision] = {}
        needs: dict[str, list[Need]] = {}
        for mission, seen in missions(histories.values()).items():
            for av, history in histories.items():
                need = None if mission in self._served else self._need(av, history, mission, seen)
                if need is not None:
                    needs.setdefault(mission, []).append(need)
        for mission, candidates in needs.items():
            if mission in self._served:
                continue
            guide = self._choose(mission, candidates)
            if guide is not None:
                self._guide[mission] = guide
                action = self._yield(guide, histories[guide.av])
                if action is not None:
                    decisions[guide.av] = Decision(action)
        return decisions

    def _need(self, av: str, history: History, mission: str, seen: Seen) -> Need | None:
        """Where this AV's path conflicts with the mission vehicle's; None without a conflict."""
        guide, conflict = self._guide.get(mission), find_conflict(self.context.road, history, seen)
        if guide is not None and self._merged(guide, av, history, seen, conflict):
            self._served.add(mission)
            return None
        return None if conflict is None else Need(av, conflict)

    def _merged(self, guide: Need, av: str, history: History, seen: Seen, conflict: Conflict | None) -> bool:
        """Whether the mission vehicle has merged ahead of its guide or is inside the junction."""
        own = history.route.paths[1]
        if own is None or seen.lane < 0:
            return False
        if guide.conflict.crossing:
            return self.context.road.lanes[seen.lane].internal or seen.lane in own.lanes
        return conflict is not None and guide.av == av and seen.lane in own.lanes[:3]

    def _choose(self, mission: str, candidates: list[Need]) -> Need | None:
        present = {n.av: n for n in candidates}
        before = self._guide.get(mission)
        chosen = None if before is None else present.get(before.av)
        if chosen is not None and (
            chosen.conflict.crossing or MIN_LAG <= chosen.conflict.behind <= 2 * MAX_LAG
        ):
            return chosen
        fitting = [
            n
            for n in candidates
            if (
                MIN_UPSTREAM <= n.conflict.behind <= MAX_UPSTREAM
                if n.conflict.crossing
                else MIN_LAG <= n.conflict.behind <= MAX_LAG
            )
        ]
        return min(fitting, key=lambda n: n.conflict.behind, default=None)

    def _yield(self, need: Need, history: History) -> MetaAction | None:
        """The guide's action; None when it is so close to its leader that IDM has to drive."""
        if need.conflict.crossing:
            wanted = CRAWL_SPEED
        else:
            if need.conflict.from_right and is_free(history, LEFT):
                return MetaAction.LANE_LEFT
            wanted = max(need.conflict.speed - PACE_SPEED_OFFSET, MIN_PACE_SPEED)
        if history.lane_changing:
            return MetaAction.IDLE
        if history.target_speed > wanted + 2.5:
            return MetaAction.DECELERATE  # in a tight platoon too: braking opens the gap to the leader
        return None if self._too_close(history) else MetaAction.IDLE

    def _too_close(self, history: History) -> bool:
        """Whether the gap to the leader is below IDM's desired gap, even with a faster leader."""
        own, speed = history.route.paths[1], history.ego_speed
        if own is None:
            return False
        for ahead, other in along(history, own):
            if ahead > 0.0 and ahead - CAR_LENGTH < 1.1 * desired_gap(speed, min(other, speed)):
                return True
        return False
