"""Thresholds of the safety prioritizer and the driving limits behind them."""

from dataclasses import dataclass

import numpy as np

from cosim.errors import in_range
from cosim.types import MetaAction


@dataclass(frozen=True, slots=True)
class Thresholds:
    """When an action is unsafe (docs/reference/paper_map.md)."""

    safe_th: float = 3.0  # s, P: safe_th
    critical_th: float = 1.5  # s, P: critical_th

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(self, not_negative="safe_th critical_th")


@dataclass(frozen=True, slots=True)
class SafetyConfig(Thresholds):
    """Thresholds, and the driving limits behind them."""

    decay: float = 0.5  # 1/s, lambda of the weights
    cap: float = 10.0  # s, time to collision counts no further
    horizon: float = 4.0  # s, P, Table I
    dt: float = 0.2  # s
    margin_length: float = 1.0  # m, added to the ego's box along
    margin_width: float = 0.6  # m, and across: half of the space between cars in neighbouring lanes
    reach: float = 125.0  # m, as the kinematic rows
    reaction: float = 0.4  # s until the next decision can brake
    # s that an action is held before braking, as far as cars ahead in the own lane are concerned; longer than
    # the horizon: to its end, as P's algorithm 2 has it
    brake_after: float = 0.8
    leader_brake: float = 8.0  # m/s2, a leader's hardest expected braking
    standstill_gap: float = 1.0  # m left between standing cars
    follower_reaction: float = 0.5  # s of a new follower
    follower_brake: float = 3.0  # m/s2, the most that a lane change may ask of it
    follower_gap: float = 2.0  # m, at least
    lane_change_speed: float = 3.0  # m/s: slower, a car cannot get sideways within a lane change's time
    straddle: float = 1.0  # m beside the centre line: a car whose rear stands there blocks two lanes
    lane_half: float = 1.6  # m from a centre line within which a vehicle is in that lane
    same_way: float = 1.05  # rad, headings closer than this (60 degrees) drive the same way
    # whether the car itself gives way, keeps its distance and its route (preset `lawful`): then vehicles on
    # crossing ways, cars ahead in the own lane and the ends of lanes make nothing unsafe
    assisted: bool = False
    resume_below: float = 0.5  # of the speed limit: slower commands are not kept among equal values
    # among equally valued actions: keep going, else give way, else evade
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
        """Steps of a rollout: far enough to see every contact that either threshold asks about."""
        seen = max(self.horizon + self.critical_th, self.safe_th + 0.5 * self.horizon)  # s
        return int(np.ceil(seen / self.dt - 1e-9))
