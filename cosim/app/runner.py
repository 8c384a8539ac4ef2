"""Builds everything one run needs inside its own process: the roof that joins SUMO and the agent."""

from __future__ import annotations

from collections.abc import Callable

from cosim.determinism import make_torch_deterministic
from cosim.episode import Episode, run_episode
from cosim.scenario import Scenario
from cosim.simulation.sumo import SumoSimulator
from cosim.types import EpisodeResult, ObservationConfig
from policy.agents import make


class Runner:
    """One scenario, one policy, any number of episodes; lives in a `cosim.worker.Worker`.

    Raises BadInput for an unknown policy and for input that SUMO refuses.
    """

    def __init__(
        self, scenario: Scenario, policy: str, svo: float, observation: ObservationConfig | None = None
    ) -> None:
        self._policy = make(policy)
        self._svo = svo
        wanted = observation or self._policy.observation
        make_torch_deterministic()
        self._simulator = SumoSimulator(
            scenario, av_parameters=self._policy.av_parameters, history=wanted.frames
        )
        self._episode = Episode(scenario, self._simulator, wanted)

    def run(self, seed: int, progress: Callable[[float, float], None] | None = None) -> EpisodeResult:
        """One whole episode."""
        return run_episode(self._episode, self._policy, seed, svo=self._svo, progress=progress)

    def close(self) -> None:
        """End the simulation."""
        self._simulator.close()
