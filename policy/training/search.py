"""Search over the habits of `altruist` by CMA-ES, on logarithms: every habit keeps its sign and its unit.

A candidate's effect on traffic shows in whole episodes, not in single decisions. So every candidate drives
the same roads, and each road ranks the candidates; the mean rank is what the search minimises. Ranks do not
depend on how much delay a road has.
"""

from collections.abc import Sequence
from dataclasses import astuple, replace

import cma
import numpy as np
from scipy.stats import rankdata

from cosim.seeding import generator
from cosim.types import Floats
from policy.agents.yield_rule import HABITS, Habits

START = replace(HABITS, queue=0.1)  # a habit of 0 has no logarithm
SPREAD = 0.4  # of the logarithms, at the beginning
POPULATION = 8


class Search:
    """The state of a search; it follows from its seed and the ranks told so far."""

    def __init__(self, seed: int) -> None:
        random = generator(seed, "habits")
        options = {
            "popsize": POPULATION,
            "seed": np.nan,  # the state of numpy's own generator is not touched
            "randn": lambda *shape: random.standard_normal(shape),
            "verbose": -9,
        }
        self._search = cma.CMAEvolutionStrategy(np.log(astuple(START)), SPREAD, options)
        self._asked: list[Floats] = []

    def ask(self) -> list[Habits]:
        """The candidates of the next generation."""
        self._asked = self._search.ask()
        return [_habits(values) for values in self._asked]

    def tell(self, ranks: Sequence[float]) -> None:
        """The mean rank of each of these candidates (`mean_ranks`)."""
        self._search.tell(self._asked, [*ranks])

    @property
    def centre(self) -> Habits:
        """The centre of the distribution: what the search has found so far."""
        return _habits(self._search.result.xfavorite)

    @property
    def spread(self) -> float:
        """Standard deviation of the logarithms, a mean over the habits."""
        return float(np.mean(self._search.result.stds))


def mean_ranks(costs: Floats) -> list[float]:
    """The mean rank of each candidate over the roads, 1 for the least cost. `costs`: [roads, candidates]."""
    return [float(rank) for rank in rankdata(costs, axis=1).mean(axis=0)]


def _habits(values: Floats) -> Habits:
    return Habits(*np.exp(values).tolist())
