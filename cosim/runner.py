"""Builds everything one run needs inside its own process: the roof that joins SUMO and the agent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from cosim.episode import Episode, run_episode
from cosim.policies import make
from cosim.recording.watcher import Watched, Watcher
from cosim.scenario import Scenario
from cosim.scenario.manifest import POLICY_FILES, digests
from cosim.scenario.sumo_outputs import drafts
from cosim.types import EpisodeResult, ObservationConfig, Policy
from cosim.workers.determinism import make_torch_deterministic


class Runner:
    """One scenario, one policy (a name or an object), any number of episodes; lives in a `Worker`.

    Raises BadInput for an unknown policy and for input that SUMO refuses.
    """

    def __init__(
        self,
        scenario: Scenario,
        policy: str | Policy,
        svo: float,
        observation: ObservationConfig | None = None,
    ) -> None:
        from cosim.simulation.sumo import SumoSimulator  # libsumo: only here, in the worker's process

        self._policy = make(policy) if isinstance(policy, str) else policy
        self._svo = svo
        wanted = observation or self._policy.observation
        self._policy_files = digests(getattr(self._policy, "files", ()))
        make_torch_deterministic()
        self._simulator = SumoSimulator(
            scenario, av_parameters=self._policy.av_parameters, history=wanted.frames
        )
        self._episode = Episode(scenario, self._simulator, wanted)

    def policy_files(self) -> dict[str, str]:
        """SHA-256 of what decides how the policy drives, by file name: its weights, its own code."""
        return self._policy_files

    def run(
        self,
        seed: int,
        progress: Callable[[float, float], None] | None = None,
        *,
        outputs: Sequence[str] = (),
        folder: Path | None = None,
    ) -> EpisodeResult:
        """One whole episode; SUMO's own `outputs` (`cosim.scenario.sumo_outputs`) go whole into `folder`."""
        return self._drive(self._episode, self._policy, seed, progress, outputs, folder)

    def watch(
        self,
        seed: int,
        progress: Callable[[float, float], None] | None = None,
        *,
        outputs: Sequence[str] = (),
        folder: Path | None = None,
    ) -> tuple[EpisodeResult, Watched]:
        """`run`, watched: the same result, and what a replay draws."""
        watcher = Watcher(self._simulator, self._policy)
        episode = Episode(self._episode.scenario, watcher.simulator, self._episode.observation)
        result = self._drive(episode, watcher.policy, seed, progress, outputs, folder)
        return result, watcher.watched(result.document())

    def _drive(
        self,
        episode: Episode,
        policy: Policy,
        seed: int,
        progress: Callable[[float, float], None] | None,
        outputs: Sequence[str],
        folder: Path | None,
    ) -> EpisodeResult:
        with drafts(outputs, folder) as files:
            self._simulator.write_outputs(files)
            try:
                result = run_episode(episode, policy, seed, svo=self._svo, progress=progress)
                return replace(result, manifest=result.manifest | {POLICY_FILES: self._policy_files})
            finally:
                if files:
                    self._simulator.finish_outputs()

    def close(self) -> None:
        """End the simulation."""
        self._simulator.close()
