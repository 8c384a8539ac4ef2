"""Resets: the parser that libsumo ships is kept awake, which is a fifth of their time and changes nothing."""

from __future__ import annotations

from cosim.scenario import Scenario, load
from cosim.simulation.sumo import SumoSimulator
from cosim.simulation.xerces import keep_initialized
from cosim.types import Snapshot
from cosim.workers.worker import Worker


class Awake:
    """A simulator, and whether its process holds the parser."""

    def __init__(self, scenario: Scenario) -> None:
        self._simulator = SumoSimulator(scenario)

    def found(self) -> bool:
        return keep_initialized()

    def reset(self, seed: int) -> Snapshot:
        return self._simulator.reset(seed)[-1]


def test_libsumo_s_parser_is_found_and_the_same_seed_stays_the_same_episode() -> None:
    with Worker(Awake, load("merge", demand=["contested"])) as worker:
        first, other, again = (worker.call("reset", seed) for seed in (100_001, 100_002, 100_001))
        assert worker.call("found")
    assert first.ids == again.ids
    assert (first.x == again.x).all()
    assert (first.x.shape != other.x.shape) or (first.x != other.x).any()
