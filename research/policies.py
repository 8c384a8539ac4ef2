"""Policies that claims alone compare: a shipped one with fewer senses (`LABEL=research.policies:NAME`)."""

from __future__ import annotations

from dataclasses import replace

from cosim.types import PolicyContext
from policy.agents.approaches import compact
from policy.agents.prediction_aware import PredictionAware

SHORT_RANGE = 25.0  # m


class Alone(PredictionAware):
    """An approach whose AVs share neither what they perceive nor what they intend."""

    def __init__(self, approach: str, perception_range: float | None = None) -> None:
        config = compact(approach)
        seen = replace(
            config.observation,
            share_perception=False,
            perception_range=perception_range or config.observation.perception_range,
        )
        super().__init__(approach, replace(config, observation=seen))

    def reset(self, context: PolicyContext) -> None:
        """A new episode, in which no intention is shared."""
        super().reset(replace(context, share_intentions=False))


def without_v2v() -> Alone:
    """`vfn-p` without V2V."""
    return Alone("vfn-p")


def alone_25_m() -> Alone:
    """`vfn-p` without V2V, which perceives 25 m."""
    return Alone("vfn-p", SHORT_RANGE)
