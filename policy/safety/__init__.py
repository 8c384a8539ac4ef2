"""The safety prioritizer (P, algorithms 2 and 3): a mask of actions that would lead to a collision."""

from policy.safety.config import SafetyConfig, Thresholds
from policy.safety.maneuver import LANE_END
from policy.safety.prioritizer import Evaluation, evaluate, front_to_back, prioritize, select

__all__ = [
    "LANE_END",
    "Evaluation",
    "SafetyConfig",
    "Thresholds",
    "evaluate",
    "front_to_back",
    "prioritize",
    "select",
]
