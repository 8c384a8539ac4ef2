"""Episodes for a trainer, driven by the learning agent in supervised processes: the roof over both sides."""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from cosim.episode import Episode
from cosim.errors import SimulationCrashed
from cosim.rewards import RewardConfig, rewards
from cosim.scenario import load
from cosim.seeding import generator
from cosim.simulation.sumo import SumoSimulator
from cosim.workers.determinism import make_torch_deterministic
from cosim.workers.worker import Worker
from policy.agents.approaches import AgentConfig
from policy.checkpoint import load as load_weights
from policy.training.curriculum import Drive, Drove, Lesson
from policy.training.explorer import ExploreConfig, Explorer

FIGURES = (
    "crashed",
    "mission_success",
    "dt_mean_m",
    "dt_av_m",
    "dt_mission_m",
    "veto_rate",
    "hard_brakings_av",
    "av_caused_collisions",
)


class Rollout:
    """Drives one episode after another; lives in a `cosim.workers.worker.Worker`."""

    def __init__(self, name: str, agent: AgentConfig, explore: ExploreConfig, reward: RewardConfig) -> None:
        make_torch_deterministic()
        self.agent = Explorer(name, agent, explore)
        self._reward = reward
        self._lesson: Lesson | None = None
        self._loaded: dict[str, str] = {}
        self._simulator: SumoSimulator | None = None

    def drive(self, drive: Drive) -> Drove:
        """One whole episode."""
        episode, agent = self.episode(drive.lesson), self.agent
        self._weights("vfn", agent.vfn, drive.weights)
        self._weights("frozen", agent.frozen, drive.frozen)
        return drive_episode(episode, agent, drive, self._reward)

    def episode(self, lesson: Lesson) -> Episode:
        """Where this lesson is driven: that of the last one, where it is the same."""
        if self._lesson != lesson:
            self.close()
            scenario = load(lesson.scenario, demand=[lesson.demand], behavior=lesson.behavior)
            wanted = self.agent.observation
            self._simulator = SumoSimulator(
                scenario, av_parameters=self.agent.av_parameters, history=wanted.frames
            )
            self._current = Episode(scenario, self._simulator, wanted)
            self._lesson = lesson
        return self._current

    def close(self) -> None:
        """End the simulation."""
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None

    def _weights(self, slot: str, network: Any, file: str) -> None:
        if file and self._loaded.get(slot) != file:
            load_weights(Path(file), {"vfn": network}, {"vfn": self.agent.config.vfn})
            self._loaded[slot] = file


def drive_episode(episode: Episode, agent: Explorer, drive: Drive, reward: RewardConfig) -> Drove:
    """One whole episode with the learning agent; its networks are as they are."""
    histories = episode.start(drive.seed)
    agent.reset(episode.context(drive.svo))
    label = f"{drive.lesson.scenario}/{drive.lesson.demand}/{drive.seed}"
    rng = generator(drive.seed, "explore")
    agent.episode(label, drive.epsilon, rng, drive.guided, drive.record)
    earned: list[float] = []
    while True:
        decisions = agent.decide(histories)  # the last state is decided upon too: its mask is needed
        if episode.over:
            break
        before = episode.snapshot
        histories = episode.advance(decisions)
        collisions = episode.events.collisions
        actions = {av: decision.action for av, decision in decisions.items()}
        terms = rewards(before, episode.snapshot, tuple(decisions), actions, drive.svo, reward, collisions)
        earned += [t.total for t in terms.values()]
        crashed = frozenset(v for c in collisions for v in (c.collider, c.victim))
        agent.pay(terms, crashed, frozenset(histories))
    trajectories = agent.finish()
    result = episode.result(agent.name)
    figures: dict[str, float | None] = {
        name: None if (v := result.value(name)) is None else float(v) for name in FIGURES
    }
    # a crash ends the episode: the decisions that were not driven count as nothing earned
    planned = round(episode.scenario.duration / episode.scenario.timing.decision)
    avs = len(earned) / max(result.steps, 1)
    figures["reward"] = float(np.sum(earned)) / max(avs * planned, 1.0)
    figures["steps"] = float(result.steps)
    figures |= {name: float(s) for name, s in episode.timings.items()}
    return Drove(trajectories, figures)


class Rollouts:
    """`policy.training.vfn.Actors` on `workers` supervised processes; a dead one's drive is done again."""

    def __init__(self, workers: int, *factory: Any) -> None:
        self._factory = factory
        self._local = threading.local()
        self._alive: list[Worker] = []
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="rollout")

    def submit(self, drive: Drive) -> Future[Drove]:
        """Drive it on the next free process. The future raises SimulationCrashed after three deaths."""
        return self._pool.submit(self._drive, drive)

    def close(self) -> None:
        """End every process."""
        self._pool.shutdown(cancel_futures=True)
        for worker in self._alive:
            worker.close()

    def __enter__(self) -> Rollouts:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _drive(self, drive: Drive) -> Drove:
        for attempt in range(3):
            worker: Worker | None = getattr(self._local, "worker", None)
            try:
                if worker is None:
                    worker = self._local.worker = Worker(Rollout, *self._factory, name="cosim-rollout")
                    self._alive.append(worker)
                drove: Drove = worker.call("drive", drive)
                return drove
            except SimulationCrashed:
                self._local.worker = None
                if attempt == 2:
                    raise
        raise AssertionError("unreachable")
