"""Thresholds and driving limits of the safety prioritizer."""

from dataclasses import dataclass

import numpy as np

from cosim.errors import in_range
from cosim.types import MetaAction


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Thresholds of an unsafe action (docs/reference/paper_map.md)."""

    safe_th: float = 3.0  # s, P: safe_th
    critical_th: float = 1.5  # s, P: critical_th

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(self, not_negative="safe_th critical_th")


@dataclass(frozen=True, slots=True)
class SafetyConfig(Thresholds):
    """Thresholds and driving limits."""

    decay: float = 0.5  # 1/s, lambda of the weights
    cap: float = 10.0  # s, cap of the time to collision
    horizon: float = 4.0  # s, P, Table I
    dt: float = 0.2  # s
    margin_length: float = 1.0  # m, added to the length of the ego's box
    margin_width: float = 0.6  # m, added to its width: half of the space between cars in adjacent lanes
    reach: float = 125.0  # m, as for the kinematic rows
    reaction: float = 0.4  # s until the next decision
    # s that an action is held before braking, for vehicles ahead in the own lane; a value above the horizon
    # holds it to the end, as in P's algorithm 2
    brake_after: float = 0.8
    leader_brake: float = 8.0  # m/s2, hardest expected braking of a leader
    standstill_gap: float = 1.0  # m between standing cars
    follower_reaction: float = 0.5  # s, reaction time of a new follower
    follower_brake: float = 3.0  # m/s2, largest deceleration that a lane change may impose on it
    follower_gap: float = 2.0  # m, minimum
    lane_change_speed: float = 3.0  # m/s, minimum: a slower car needs too long to change lanes
    straddle: float = 1.0  # m, lateral offset of the rear from which a standing car blocks two lanes
    lane_half: float = 1.6  # m, half of a lane's width
    same_way: float = 1.05  # rad (60 degrees), largest heading difference of vehicles in the same direction
    # True with preset `lawful`: the car itself gives way, keeps its distance and its route. Then crossing
    # vehicles, vehicles ahead in the own lane and lane ends make no action unsafe
    assisted: bool = False
    resume_below: float = 0.5  # share of the speed limit: slower commands lose among equal values
    # order of equally valued actions: keep going, then give way, then evade
    ties: tuple[MetaAction, ...] = (
        MetaAction.IDLE,
        MetaAction.DECELERATE,
        MetaAction.ACCELERATE,
        MetaAction.LANE_LEFT,
        MetaAction.LANE_RIGHT,
    )

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        Thresholds.__post_init__(self)
        lengths = "margin_length margin_width reach reaction brake_after standstill_gap follower_reaction"
        in_range(
            self,
            positive="cap horizon dt leader_brake follower_brake straddle lane_half same_way",
            not_negative=f"decay {lengths} follower_gap lane_change_speed resume_below",
        )

    @property
    def frames(self) -> int:
        """Steps of a rollout, enough for every contact within either threshold."""
        seen = max(self.horizon + self.critical_th, self.safe_th + 0.5 * self.horizon)  # s
        return int(np.ceil(seen / self.dt - 1e-9))
