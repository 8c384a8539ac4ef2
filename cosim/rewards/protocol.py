"""The protocol of a reward: a function from one decision of the traffic to each AV's reward."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from cosim.types import Collision, MetaAction, Snapshot


class RewardStep(NamedTuple):
    """One decision period (0.4 s) of the traffic."""

    before: Snapshot  # all vehicles at the decision
    after: Snapshot  # all vehicles at the end of the period; `after.events` are the last frame's only
    avs: tuple[str, ...]  # AVs of `before` to be rewarded; an AV missing in `after` left the road
    actions: Mapping[str, MetaAction]  # commands of the AVs; a missing AV had none
    svo: float  # rad, phi: 0 egoistic, pi/2 altruistic
    collisions: Sequence[Collision]  # of the whole period


class RewardTerms(NamedTuple):
    """One AV's reward and its parts (no unit); total = cos(phi) ego + sin(phi) (av_social + hv_social)."""

    ego: float  # r_i
    av_social: float  # sum over the other AVs of r_AV(i, j)
    hv_social: float  # sum over HVs of r_HV(i, k)
    total: float  # R_i


class Reward(Protocol):
    """A callable without state between decisions."""

    def __call__(self, step: RewardStep) -> Mapping[str, RewardTerms | float]:
        """The reward of each of `step.avs`: its terms, or the total alone."""
