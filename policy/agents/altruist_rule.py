"""A scripted altruist: the AV best placed opens the gap for the mission vehicle, everybody else drives IDM.

It shows what altruism can gain without learning anything (research/claims/altruism.yaml) and is the yardstick
for the learned policies. AVs share what they know (V2V), so one guide is chosen for all of them.
"""

from collections.abc import Mapping
from typing import NamedTuple

from cosim.types import Decision, History, MetaAction, PolicyContext
from policy.agents.idm import Idm, desired_gap
from policy.inputs.meeting import CAR, LANE, Meeting, Seen, along, meet, missions

# When the guide yields and how much; m, m/s
BEHIND_MIN = -5.0  # a guide this far ahead of the mission vehicle can still fall back
BEHIND_MAX = 80.0  # further back its gap would come too late
UPSTREAM_MIN = 60.0  # junctions: stopping at the line does not help, the gap opens upstream
UPSTREAM_MAX = 260.0
CRAWL = 2.0  # the guide waits upstream of a junction (on the grid: it stops)
PACE_BELOW = 5.0  # beside an ending lane the guide drives this much slower than the other
PACE_MIN = 5.0  # and never slower than this
CLEAR = 10.0  # a free left lane: this much space ahead and behind,
CLEAR_TIME = 0.8  # s of a follower's way on top,
MAX_CLOSING = 3.0  # m/s that a follower there may be faster,
CLOSING_TIME = 3.0  # s of what the two close in on each other


class Need(NamedTuple):
    """How one AV stands to the mission vehicle."""

    av: str
    meeting: Meeting


class AltruistRule(Idm):
    """Left if the left lane is free, else slower; at junctions slower, far upstream."""

    name = "altruist-rule"

    def reset(self, context: PolicyContext) -> None:
        """A new episode: nobody has been served yet."""
        super().reset(context)
        self._served: set[str] = set()
        self._guide: dict[str, Need] = {}  # mission vehicle -> its guide

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """At most one command per mission vehicle: the guide's."""
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
        """Whether this AV's way meets the mission vehicle's, and where; None when it does not."""
        guide, meeting = self._guide.get(mission), meet(self.context.road, history, seen)
        if guide is not None and self._is_served(guide, av, history, seen, meeting):
            self._served.add(mission)
            return None
        return None if meeting is None else Need(av, meeting)

    def _is_served(self, guide: Need, av: str, history: History, seen: Seen, meeting: Meeting | None) -> bool:
        """Whether the mission vehicle drives where its guide meant it to: before it, or in the junction."""
        own = history.route.paths[1]
        if own is None or seen.lane < 0:
            return False
        if guide.meeting.crossing:
            return self.context.road.lanes[seen.lane].internal or seen.lane in own.lanes
        return meeting is not None and guide.av == av and seen.lane in own.lanes[:3]

    def _choose(self, mission: str, candidates: list[Need]) -> Need | None:
        present = {n.av: n for n in candidates}
        before = self._guide.get(mission)
        chosen = None if before is None else present.get(before.av)
        if chosen is not None and (
            chosen.meeting.crossing or BEHIND_MIN <= chosen.meeting.behind <= 2 * BEHIND_MAX
        ):
            return chosen
        fitting = [
            n
            for n in candidates
            if (
                UPSTREAM_MIN <= n.meeting.behind <= UPSTREAM_MAX
                if n.meeting.crossing
                else BEHIND_MIN <= n.meeting.behind <= BEHIND_MAX
            )
        ]
        return min(fitting, key=lambda n: n.meeting.behind, default=None)

    def _yield(self, need: Need, history: History) -> MetaAction | None:
        """What the guide does; None: it is so close to its leader that IDM shall drive."""
        if need.meeting.crossing:
            wanted = CRAWL
        else:
            if need.meeting.from_right and self._left_is_free(history):
                return MetaAction.LANE_LEFT
            wanted = max(need.meeting.speed - PACE_BELOW, PACE_MIN)
        if history.lane_changing:
            return MetaAction.IDLE
        if history.target_speed > wanted + 2.5:
            return MetaAction.DECELERATE  # in a tight platoon too: braking opens the gap to the leader
        return None if self._too_close(history) else MetaAction.IDLE

    def _left_is_free(self, history: History) -> bool:
        """Nobody there, nobody who would have to brake hard for us, nobody we would run into."""
        speed = history.ego_speed
        left = history.route.paths[0]
        if left is None or history.route.to_end(0) < 100.0 or history.lane_changing:
            return False
        for ahead, other in along(history, left, side=LANE):
            if ahead < 0.0 and other - speed > MAX_CLOSING:
                return False  # a guide that has slowed down already stays in its lane
            behind = CLEAR + other * CLEAR_TIME + max(other - speed, 0.0) * CLOSING_TIME
            front = CLEAR + max(speed - other, 0.0) * CLOSING_TIME
            if -behind < ahead < front:
                return False
        return True

    def _too_close(self, history: History) -> bool:
        """Closer to a leader than IDM's own wish, even if the leader is getting away."""
        own, speed = history.route.paths[1], history.ego_speed
        if own is None:
            return False
        for ahead, other in along(history, own):
            if ahead > 0.0 and ahead - CAR < 1.1 * desired_gap(speed, min(other, speed)):
                return True
        return False
