"""Episodes for a trainer, driven by the learning agent in supervised processes."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from cosim.control import courtesy
from cosim.episode import Episode, Step, run_episode
from cosim.host import Earnings, Host, Hosts
from cosim.metrics import MetricFactory
from cosim.rewards import Reward, read
from cosim.scenario import load
from cosim.seeding import generator
from cosim.types import Preset
from cosim.workers.supervisor import Limits, Supervisor
from cosim.workers.tasks import Task
from policy.agents.approaches import AgentConfig
from policy.checkpoint import load as load_weights
from policy.training.curriculum import Drive, DriveResult, Lesson
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
LIMITS = Limits(step=300.0, crashes=3)  # an iteration needs all of its episodes: three attempts


class Rollout(Hosts):
    """Drives one episode after another; runs in a worker process.

    `reward` and `metrics` are objects, or texts as `cosim.rewards.read` and `cosim.metrics.read` accept them.
    """

    def __init__(
        self,
        name: str,
        agent: AgentConfig,
        explore: ExploreConfig,
        reward: str | Reward,
        metrics: Sequence[str | MetricFactory] = (),
    ) -> None:
        super().__init__()
        self.agent = Explorer(name, agent, explore)
        self._reward, self._metrics = read(reward), metrics
        self._loaded: dict[str, str] = {}

    def run(self, drive: Drive, progress: Any = None) -> DriveResult:
        """One whole episode; with a user's metrics every figure is logged."""
        episode, agent = self.episode(drive.lesson, drive.errors, drive.preset), self.agent
        episode.simulator.courtesy = courtesy(drive.svo)
        self._weights("vfn", agent.vfn, drive.weights)
        self._weights("frozen", agent.frozen, drive.frozen)
        return drive_episode(episode, agent, drive, self._reward, progress, every=bool(self._metrics))

    def episode(self, lesson: Lesson, errors: str = "", preset: str = Preset.UNGUARDED) -> Episode:
        """The episode object of this lesson and error level, reused from the last lesson if equal."""

        def build() -> Host:
            scenario = load(
                lesson.scenario,
                demand=[lesson.demand],
                behavior=lesson.behavior,
                preset=preset,
                errors=errors or None,
            )
            return Host(scenario, self.agent, 0.0, metrics=self._metrics)

        return self.host((lesson, errors, preset), build).episode

    def _weights(self, slot: str, network: Any, file: str) -> None:
        if file and self._loaded.get(slot) != file:
            load_weights(Path(file), {"vfn": network}, {"vfn": self.agent.config.vfn})
            self._loaded[slot] = file


class Payments(Earnings):
    """Rewards of every commanded AV, passed to the learning agent."""

    def __init__(self, agent: Explorer, drive: Drive, reward: Reward) -> None:
        super().__init__(reward, drive.svo)
        self._agent, self._drive = agent, drive

    def on_start(self, episode: Episode) -> None:
        """Start the agent's exploration and recording."""
        d, seed = self._drive, episode.seed
        label = f"{d.lesson.scenario}/{d.lesson.demand}/{seed}"
        self._agent.episode(label, d.epsilon, generator(seed, "explore"), d.record, d.keep)

    def on_step(self, episode: Episode, step: Step) -> None:
        """One decision."""
        terms = self.pay(step, tuple(step.decisions))
        self.totals += [t.total for t in terms.values()]
        crashed = frozenset(v for c in step.events.collisions for v in c.vehicles)
        self._agent.pay(terms, crashed, frozenset(episode.histories))


def drive_episode(
    episode: Episode,
    agent: Explorer,
    drive: Drive,
    reward: Reward,
    progress: Any = None,
    *,
    every: bool = False,
) -> DriveResult:
    """One whole episode with the learning agent and its present networks. `every`: return all figures."""
    earned = Payments(agent, drive, reward)
    result = run_episode(episode, agent, drive.seed, svo=drive.svo, progress=progress, hooks=[earned])
    agent.decide(episode.histories)  # the last state needs a decision for its mask
    trajectories = agent.finish()
    figures: dict[str, float | None] = {
        name: None if (v := result.value(name)) is None else float(v)
        for name in (result.metrics if every else FIGURES)
    }
    # after a crash the remaining decisions count as reward 0
    planned = round(episode.scenario.duration / episode.scenario.timing.decision)
    avs = len(earned.totals) / max(result.steps, 1)
    figures["reward"] = float(np.sum(earned.totals)) / max(avs * planned, 1.0)
    figures["steps"] = float(result.steps)
    figures |= {name: float(s) for name, s in result.timings.items()}
    return DriveResult(trajectories, figures)


class Rollouts(contextlib.AbstractContextManager["Rollouts"]):
    """`policy.training.vfn.Actors` on `workers` supervised processes, as in a batch."""

    def __init__(self, workers: int, *factory: Any) -> None:
        self._factory = factory
        self._local = threading.local()
        self._supervisors: list[Supervisor] = []
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="rollout")

    def submit(self, drive: Drive) -> Future[DriveResult]:
        """Drive the episode on the next free process.

        The future raises SimulationCrashed when the process ended or hung as often as `LIMITS` allow.
        """
        return self._pool.submit(self._drive, drive)

    def close(self) -> None:
        """End every process."""
        self._pool.shutdown(cancel_futures=True)
        for supervisor in self._supervisors:
            supervisor.close()

    def __exit__(self, *error: object) -> None:
        self.close()

    def _drive(self, drive: Drive) -> DriveResult:
        if not hasattr(self._local, "supervisor"):
            self._local.supervisor = Supervisor(Rollout, self._factory, LIMITS)
            self._supervisors.append(self._local.supervisor)
        drove: DriveResult = self._local.supervisor.run(Task("", "", (drive,))).result()
        return drove
