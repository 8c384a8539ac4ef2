"""Loaded by the process that workers of the tests fork from: what they need, and one difference."""

from cosim.batch import episode_runner  # noqa: F401
from cosim.simulation import sumo  # noqa: F401
from cosim.workers import supervisor
from policy.agents import prediction_aware  # noqa: F401


def end_with(parent: int) -> None:
    """Nothing: a user's worker ends with the process that started it; here that is this process."""


supervisor._end_with = end_with
