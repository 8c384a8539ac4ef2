"""Social value orientation reward of both papers, equation (6) of P and (2) of T, term by term."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.errors import BadInput
from cosim.types import Collision, Floats, Kind, MetaAction, Snapshot

VARIANTS = ("p", "t")
_LANE_CHANGES = (MetaAction.LANE_LEFT, MetaAction.LANE_RIGHT)
_SPEED_CHANGES = (MetaAction.ACCELERATE, MetaAction.DECELERATE)


@dataclass(frozen=True, slots=True)
class RewardConfig:
    """Weights w_m of the traffic metrics x_m and what couples vehicles. Every weight multiplies a number
    that is 0 or 1 (crash, lane change, speed change) or lies between 0 and 1 (speed, distance), once a
    decision."""

    variant: str = "p"  # "p": eq. (6) of P, decays with distance; "t": T, no decay, r_i pays for maneuvers
    crash: float = -5.0  # for a vehicle that crashed in this decision; -5 in code of the same authors
    speed: float = 1.0  # times speed / reference_speed at the decision's end; 1 in the same code
    distance: float = 1.0  # times distance / (reference_speed * duration); as much as speed: P names both
    lane_change: float = -0.3  # variant t, r_i only, for commanding one; 0.3 in the same code
    acceleration: float = -0.1  # variant t, r_i only, for Accelerate and Decelerate; less than a lane change
    reference_speed: float = 30.0  # m/s, where speed and distance saturate: AVs drive 25-30 m/s in the papers
    eta: float = 1.0  # exponent of the distance decay (P, eq. (6)); not stated there: 1
    nearest: float = 5.0  # m, distances below it count as this: a vehicle's length, so that none dominates
    mission: float = 20.0  # a mission vehicle's utility counts as this many bystanders': altruism was
    # learned with 20 and not with 1, where its gain drowns among those who merely drive by
    social: float = 1.0  # of every other's utility against the own: with eta = 0 twenty add up undiminished
    perception_range: float = 125.0  # m, only neighbours an AV perceives count (ObservationConfig)

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise BadInput(f"must be one of {', '.join(VARIANTS)}", field="variant", value=self.variant)
        for name in ("reference_speed", "nearest", "perception_range"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise BadInput("must be a positive number", field=name, value=getattr(self, name))
        for name in ("crash", "speed", "distance", "lane_change", "acceleration", "eta", "mission", "social"):
            if not np.isfinite(getattr(self, name)):
                raise BadInput("must be a finite number", field=name, value=getattr(self, name))


class RewardTerms(NamedTuple):
    """One AV's reward and its parts (no unit); total = cos(phi) ego + sin(phi) (av_social + hv_social)."""

    ego: float  # r_i
    av_social: float  # sum over the other AVs of r_AV(i, j)
    hv_social: float  # sum over HVs of r_HV(i, k)
    total: float  # R_i


def rewards(
    before: Snapshot,
    after: Snapshot,
    avs: Sequence[str],
    actions: Mapping[str, MetaAction],
    svo: float,
    config: RewardConfig,
    collisions: Sequence[Collision],
) -> dict[str, RewardTerms]:
    """The reward of each of `avs` for the decision that led from `before` to `after`.

    Neighbours are the vehicles of both snapshots within `config.perception_range` m of the AV in `after`.
    `actions`: what the AVs executed (an AV left out did nothing); `svo`: phi in rad, 0 egoistic, pi/2
    altruistic. `collisions`: those of the whole decision (`Episode.events`; `after.events` holds only the
    last frame's). An AV that is no longer on the road gets its crash and nothing else.
    Source: P, section IV-B, equation (6); T, equation (2).
    """
    crashed = {name for c in collisions for name in (c.collider, c.victim)}
    utility = vehicle_utility(before, after, crashed, config)  # [n]
    alive = [name for name in avs if name in after.row]
    rows = np.array([after.row[name] for name in alive], dtype=np.int64)  # [a]

    distance = np.hypot(after.x[rows, None] - after.x, after.y[rows, None] - after.y)  # [a,n] m
    coupling = (distance <= config.perception_range).astype(np.float64)  # [a,n]
    coupling[np.arange(len(rows)), rows] = 0.0
    if config.variant == "p":
        coupling *= np.maximum(distance, config.nearest) ** -config.eta
    weight = config.social * np.where(after.mission, config.mission, 1.0)  # [n]
    social = coupling * (utility * weight)  # [a,n] r(i, c)
    is_av = after.kind == Kind.AV
    av_social, hv_social = social[:, is_av].sum(axis=1), social[:, ~is_av].sum(axis=1)  # [a]

    terms = {}
    for k, name in enumerate(alive):
        ego = float(utility[rows[k]])
        if config.variant == "t":
            action = actions.get(name)
            ego += config.lane_change * (action in _LANE_CHANGES)
            ego += config.acceleration * (action in _SPEED_CHANGES)
        terms[name] = _mix(ego, float(av_social[k]), float(hv_social[k]), svo)
    for name in avs:
        if name not in terms:
            terms[name] = _mix(config.crash if name in crashed else 0.0, 0.0, 0.0, svo)
    return terms


def vehicle_utility(before: Snapshot, after: Snapshot, crashed: set[str], config: RewardConfig) -> Floats:
    """sum_m w_m x_m of every vehicle of `after`: [n], no unit; x_m: crash, speed, distance travelled (P).

    A vehicle that was not there `before` has no distance yet and counts 0, unless it crashed.
    """
    then = np.array([before.row.get(name, -1) for name in after.ids], dtype=np.int64)  # [n]
    old = then >= 0
    # the mean speed of the decision over the reference speed: distance / (reference_speed * duration)
    mean = np.zeros(after.n)  # [n] m/s
    mean[old] = 0.5 * (before.speed[then[old]] + after.speed[old])
    speed = np.where(old, np.clip(after.speed / config.reference_speed, 0.0, 1.0), 0.0)
    travelled = np.clip(mean / config.reference_speed, 0.0, 1.0)
    crash = np.array([name in crashed for name in after.ids], dtype=np.float64)  # [n]
    return np.asarray(config.crash * crash + config.speed * speed + config.distance * travelled)


def _mix(ego: float, av_social: float, hv_social: float, svo: float) -> RewardTerms:
    total = float(np.cos(svo)) * ego + float(np.sin(svo)) * (av_social + hv_social)
    return RewardTerms(ego, av_social, hv_social, total)
