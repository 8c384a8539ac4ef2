"""Rewards of a decision: the papers' rewards in one table, their weights, and a user's own reward."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cosim.errors import BadInput, one_of
from cosim.files import code
from cosim.rewards.protocol import Reward, RewardStep, RewardTerms
from cosim.rewards.svo import RewardP, RewardT
from cosim.types import Collision, MetaAction, Snapshot

__all__ = ["REWARDS", "Reward", "RewardConfig", "RewardStep", "RewardTerms", "read", "rewards"]

# name -> constructor from the weights; selected by `RewardConfig.variant`
REWARDS: dict[str, Callable[[RewardConfig], Reward]] = {"p": RewardP, "t": RewardT}


@dataclass(frozen=True, slots=True)
class RewardConfig:
    """Weights w_m of the traffic metrics x_m and the coupling of vehicles. Once per decision, every weight
    multiplies a number that is 0 or 1 (crash, lane change, speed change) or between 0 and 1 (speed,
    distance)."""

    variant: str = "p"  # of `cosim.rewards.REWARDS`; "p": decays with distance; "t": r_i pays for maneuvers
    crash: float = -5.0  # for a vehicle that crashed in this decision; -5 in code of the same authors
    speed: float = 1.0  # times final speed / `REFERENCE_SPEED`; 1 in the same code
    distance: float = 1.0  # times distance / (`REFERENCE_SPEED` * duration); equal to speed: P names both
    lane_change: float = -0.3  # variant t, r_i only, for commanding one; 0.3 in the same code
    acceleration: float = -0.1  # variant t, r_i only, for Accelerate and Decelerate; less than a lane change
    eta: float = 1.0  # exponent of the distance decay (P, eq. (6)); not stated there: 1
    mission: float = 20.0  # weight of a mission vehicle's utility against a bystander's. Altruism
    # was learned with 20 and not with 1, where bystanders dominate the sum
    social: float = 1.0  # weight of the others' utility against the ego's: with eta = 0 twenty add up fully
    perception_range: float = 125.0  # m, only perceived neighbours count (ObservationConfig)

    def __post_init__(self) -> None:
        one_of(self.variant, REWARDS, "variant")
        if not 0.0 < self.perception_range < np.inf:
            raise BadInput("must be a positive number", field="perception_range", value=self.perception_range)
        for name in ("crash", "speed", "distance", "lane_change", "acceleration", "eta", "mission", "social"):
            if not np.isfinite(getattr(self, name)):
                raise BadInput("must be a finite number", field=name, value=getattr(self, name))

    def __call__(self, step: RewardStep) -> Mapping[str, RewardTerms | float]:
        """The reward of this variant and these weights (`cosim.rewards.Reward`)."""
        return REWARDS[self.variant](self)(step)


def rewards(
    before: Snapshot,
    after: Snapshot,
    avs: Sequence[str],
    actions: Mapping[str, MetaAction],
    svo: float,
    reward: Reward,
    collisions: Sequence[Collision],
) -> dict[str, RewardTerms]:
    """The reward of each of `avs` for the decision from `before` to `after`.

    The arguments are those of `RewardStep`. A number alone counts as the AV's own part r_i and as the total.

    Raises BadInput when an AV is missing or not one of `avs`, or a reward is no finite number.
    """
    paid = reward(RewardStep(before, after, tuple(avs), actions, svo, collisions))
    if not isinstance(paid, Mapping) or paid.keys() != set(avs):
        got = sorted(map(str, paid)) if isinstance(paid, Mapping) else type(paid).__name__
        problem = f"must pay each of {', '.join(sorted(avs))}, and nobody else"
        raise BadInput(problem, file=code.place_of(reward), field="reward", value=got)
    return {name: _terms(name, value, code.place_of(reward)) for name, value in paid.items()}


def read(what: str | Reward, field: str = "--reward") -> Reward:
    """The reward of a name (in `REWARDS`, FILE.py:NAME or MODULE:NAME); objects are returned unchanged.

    A class is constructed without arguments; a function or another callable is the reward itself.

    Raises BadInput for an unknown reward, or code that cannot be loaded or called.
    """
    if not isinstance(what, str):
        return what
    if not code.is_code(what):
        return RewardConfig(variant=one_of(what, REWARDS, field))
    found: Reward = code.read(what, field).make(field)
    return found


def _terms(name: str, value: RewardTerms | float, file: object) -> RewardTerms:
    try:
        terms = value if isinstance(value, RewardTerms) else RewardTerms(value, 0.0, 0.0, float(value))
        if np.isfinite(terms.total):
            return terms
    except (TypeError, ValueError):
        pass
    problem = "must be a finite number or RewardTerms"
    raise BadInput(problem, file=file, field=f"reward of {name}", value=value)
