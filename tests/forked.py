"""Loaded by the process that workers of the tests fork from: what they need, and one difference."""

import policy.agents.prediction_aware  # noqa: F401
from cosim.workers import supervisor


def end_with(parent: int) -> None:
    """Nothing: a user's worker ends with the process that started it; here that is this process."""


supervisor._end_with = end_with
