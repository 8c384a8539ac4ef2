"""Social value orientation reward of both papers, equation (6) of P and (2) of T, term by term."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cosim.rewards.protocol import RewardStep, RewardTerms
from cosim.types import Floats, Kind, MetaAction, Snapshot

if TYPE_CHECKING:
    from cosim.rewards import RewardConfig

REFERENCE_SPEED = 30.0  # m/s, saturation of speed and distance: AVs drive 25-30 m/s in the papers
NEAREST = 5.0  # m, minimum distance in the decay (a vehicle's length), so that no neighbour dominates
_LANE_CHANGES = (MetaAction.LANE_LEFT, MetaAction.LANE_RIGHT)
_SPEED_CHANGES = (MetaAction.ACCELERATE, MetaAction.DECELERATE)


class RewardP:
    """P, section IV-B, equation (6): the others' utility decays with their distance.

    Neighbours are the vehicles of both snapshots within `config.perception_range` m of the AV in `after`,
    without persons.
    An AV that left the road gets the reward of its crash only.
    """

    def __init__(self, config: RewardConfig) -> None:
        self.config = config

    def __call__(self, step: RewardStep) -> dict[str, RewardTerms]:
        """The terms of each of `step.avs`."""
        config, after, svo = self.config, step.after.vehicles, step.svo
        crashed = {name for c in step.collisions for name in c.vehicles}
        utility = vehicle_utility(step.before, after, crashed, config)  # [n]
        alive = [name for name in step.avs if name in after.row]
        rows = np.array([after.row[name] for name in alive], dtype=np.int64)  # [a]

        distance = np.hypot(after.x[rows, None] - after.x, after.y[rows, None] - after.y)  # [a,n] m
        coupling = (distance <= config.perception_range).astype(np.float64)  # [a,n]
        coupling[np.arange(len(rows)), rows] = 0.0
        coupling *= self.decay(distance)
        weight = config.social * np.where(after.mission, config.mission, 1.0)  # [n]
        social = coupling * (utility * weight)  # [a,n] r(i, c)
        is_av = after.kind == Kind.AV
        av_social, hv_social = social[:, is_av].sum(axis=1), social[:, ~is_av].sum(axis=1)  # [a]

        terms = {}
        for k, name in enumerate(alive):
            ego = float(utility[rows[k]]) + self.maneuver(step.actions.get(name))
            terms[name] = _mix(ego, float(av_social[k]), float(hv_social[k]), svo)
        for name in step.avs:
            if name not in terms:
                terms[name] = _mix(config.crash if name in crashed else 0.0, 0.0, 0.0, svo)
        return terms

    def decay(self, distance: Floats) -> Floats:
        """[a,n] weight of a neighbour at `distance` [a,n] m."""
        return np.asarray(np.maximum(distance, NEAREST) ** -self.config.eta)

    def maneuver(self, action: MetaAction | None) -> float:
        """The contribution of the command `action` to r_i."""
        return 0.0


class RewardT(RewardP):
    """T, equation (2): equal weight of all neighbours, and r_i includes the cost of maneuvers."""

    def decay(self, distance: Floats) -> Floats:
        """[a,n] ones."""
        return np.ones_like(distance)

    def maneuver(self, action: MetaAction | None) -> float:
        """The weight of a lane change or of a change of speed."""
        changes = self.config.lane_change * (action in _LANE_CHANGES)
        return changes + self.config.acceleration * (action in _SPEED_CHANGES)


def vehicle_utility(before: Snapshot, after: Snapshot, crashed: set[str], config: RewardConfig) -> Floats:
    """sum_m w_m x_m of every vehicle of `after`: [n], no unit; x_m: crash, speed, distance travelled (P).

    A vehicle missing in `before` has no distance and counts 0, unless it crashed.
    """
    then = np.array([before.row.get(name, -1) for name in after.ids], dtype=np.int64)  # [n]
    old = then >= 0
    # the mean speed of the decision over the reference speed: distance / (REFERENCE_SPEED * duration)
    mean = np.zeros(after.n)  # [n] m/s
    mean[old] = 0.5 * (before.speed[then[old]] + after.speed[old])
    speed = np.where(old, np.clip(after.speed / REFERENCE_SPEED, 0.0, 1.0), 0.0)
    travelled = np.clip(mean / REFERENCE_SPEED, 0.0, 1.0)
    crash = np.array([name in crashed for name in after.ids], dtype=np.float64)  # [n]
    return np.asarray(config.crash * crash + config.speed * speed + config.distance * travelled)


def _mix(ego: float, av_social: float, hv_social: float, svo: float) -> RewardTerms:
    total = float(np.cos(svo)) * ego + float(np.sin(svo)) * (av_social + hv_social)
    return RewardTerms(ego, av_social, hv_social, total)
