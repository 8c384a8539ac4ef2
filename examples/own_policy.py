"""Your own policy, which commands all AVs at once: here only AVs that see the mission vehicle.

cosim evaluate --scenario merge --demand contested --policy idm --policy examples/own_policy.py:NearMission \
    --seeds 200000:200010 --out runs/mine
cosim compare runs/mine --baseline idm --candidate NearMission --fail-on 'collision_rate > +0.5pp'
cosim replay runs/mine KEY --beside idm
"""

from collections.abc import Mapping

from own_agent import MISSION, X, keep_distance  # a file in this folder

from cosim.types import Decision, History, ObservationConfig, PolicyContext


class NearMission:
    """`cosim.types.Policy`: AVs near the mission vehicle keep their distance, SUMO drives all others."""

    label = "an example"  # shown with every result, as a warning; optional
    observation = ObservationConfig(maps=False)  # the observation that the policy needs; maps cost time

    def reset(self, context: PolicyContext) -> None:
        """Begin an episode; `context` has the road, the clock, phi and a seeded generator."""
        self.reach = 60.0  # m

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """AV id -> decision; SUMO drives AVs without a decision."""
        return {
            av: Decision(keep_distance(seen.kinematics[-1], seen.valid[-1]))
            for av, seen in histories.items()
            if self._near(seen)
        }

    def _near(self, seen: History) -> bool:
        rows, valid = seen.kinematics[-1], seen.valid[-1]
        return bool((valid & (rows[:, MISSION] > 0) & (abs(rows[:, X]) < self.reach)).any())
