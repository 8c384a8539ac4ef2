"""What a reward is: it sees one decision of the traffic and says what each AV earned by it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from cosim.types import Collision, MetaAction, Snapshot


class RewardStep(NamedTuple):
    """One decision (0.4 s) of the traffic, from the moment it was taken to the moment of the next."""

    before: Snapshot  # every vehicle when the AVs decided
    after: Snapshot  # when the decision's period was over; `after.events` are the last frame's only
    avs: tuple[str, ...]  # who is to be rewarded: AVs of `before`; one that is not in `after` left the road
    actions: Mapping[str, MetaAction]  # what the AVs were commanded; one that is left out: nothing
    svo: float  # rad, phi: 0 egoistic, pi/2 altruistic
    collisions: Sequence[Collision]  # of the whole period


class RewardTerms(NamedTuple):
    """One AV's reward and its parts (no unit); total = cos(phi) ego + sin(phi) (av_social + hv_social)."""

    ego: float  # r_i
    av_social: float  # sum over the other AVs of r_AV(i, j)
    hv_social: float  # sum over HVs of r_HV(i, k)
    total: float  # R_i


class Reward(Protocol):
    """A function, or an object that can be called. It keeps nothing from one decision to the next."""

    def __call__(self, step: RewardStep) -> Mapping[str, RewardTerms | float]:
        """The reward of each of `step.avs`: its terms, or the total alone."""
