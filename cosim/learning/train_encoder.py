"""Training of the frame encoder on its own episodes: `cosim train encoder`."""

import argparse
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from cosim.episode import run_episode
from cosim.files import working_in
from cosim.host import Host, Hosts
from cosim.learning.announcement import announce, curves
from cosim.learning.configuration import configuration
from cosim.learning.prediction_data import spread
from cosim.scenario import load, place
from cosim.seeding import TRAINING_SEEDS, TUNING_SEEDS, generator
from cosim.types import Decision, History, MetaAction, PolicyContext
from cosim.workers.engines import LocalEngine
from cosim.workers.memory import keep_freed_memory
from cosim.workers.progress import Progress
from cosim.workers.tasks import Task
from policy.agents.approaches import AgentConfig
from policy.agents.prediction_aware import PredictionAware
from policy.training import loop as supervised
from policy.training import sight
from policy.training.config import agent_config, encoder_of
from policy.training.loop import LoopConfig
from policy.training.networks import use_threads
from policy.training.sight import AVS_PER_DECISION, DECISION_STRIDE, ERROR_LEVEL, Seen, SightTask
from sumo_scenarios import names

HELD_DECISIONS = 6.0  # mean decisions that a random action is held


class Watcher(PredictionAware):
    """Records the AVs' maps and labels; AVs are driven by SUMO or by safe random actions.

    Args:
        agent: sizes, chain and prioritizer.
    """

    def __init__(self, agent: AgentConfig) -> None:
        super().__init__("vfn-p", agent)

    def watch(self, world: int, seed: int, acts: bool) -> None:
        """Start an episode in scenario number `world`; `acts`: the AVs act at random."""
        self._world, self._acts, self._rng = world, acts, generator(seed, "watch")
        self._held: dict[str, MetaAction] = {}
        self._count = 0
        self.parts: list[Seen] = []

    def reset(self, context: PolicyContext) -> None:
        """Start an episode; times to collision are computed even if the car keeps its distance itself."""
        super().reset(context)
        self._safety = self.config.safety

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """Choose an action every few decisions and hold it in between."""
        self._count += 1
        if not histories:
            return {}
        if self._count % DECISION_STRIDE == 0:
            self._look(histories)
        return {av: Decision(self._held.get(av, MetaAction.IDLE)) for av in histories} if self._acts else {}

    def _look(self, histories: Mapping[str, History]) -> None:
        inputs = self.perceive(histories)
        agents, actions = inputs.scene.agents, len(MetaAction)
        decided = self.choose(self._rng.random((len(agents), actions)).astype(np.float32), inputs)
        for av in agents:
            if av not in self._held or self._rng.random() < DECISION_STRIDE / HELD_DECISIONS:
                self._held[av] = decided[av].action
        rows = self._rng.permutation(len(agents))[:AVS_PER_DECISION]
        past, states = self.observation.frames, inputs.states
        maps, kinematics, situation = (part.numpy()[rows] for part in states[:3])
        ttc = np.array([decided[agents[row]].ttc for row in rows], np.float32)
        later = self._rng.integers(past, maps.shape[1], size=len(rows))
        self.parts.append(sight.seen(maps, kinematics, situation, ttc, past, later, self._world))


class WatcherHost(Hosts):
    """Runs in a worker: one episode and its recorded frames."""

    def __init__(self, agent: AgentConfig) -> None:
        super().__init__()
        self._watcher = Watcher(agent)

    def run(
        self, world: str, index: int, demand: str, seed: int, errors: str, progress: Any = None
    ) -> list[Seen]:
        """Episodes alternate by seed between random actions and SUMO."""

        def build() -> Host:
            return Host(load(world, demand=[demand], errors=errors or None), self._watcher, math.pi / 4)

        host = self.host((world, demand, errors), build)
        self._watcher.watch(index, seed, acts=seed // 2 % 2 == 1)
        run_episode(host.episode, self._watcher, seed, svo=host.svo, progress=progress)
        return self._watcher.parts


def gather(agent: AgentConfig, worlds: Sequence[str], seeds: range, workers: int, title: str) -> Seen:
    """Frames of episodes with `seeds` of every demand of `worlds`, every second with human errors."""
    tasks = [
        Task(f"{world}/{demand}/{seed}", f"{world}/{demand}/{errors}", (world, index, demand, seed, errors))
        for index, world in enumerate(worlds)
        for demand in load(world).demands or {}
        for errors in ("", ERROR_LEVEL)
        for seed in seeds
        if (seed % 2 == 1) == bool(errors)
    ]
    each = spread(LocalEngine(WatcherHost, (agent,), workers=workers), tasks, title)
    return sight.joined([part for parts in each for part in parts])


def train(args: argparse.Namespace) -> int:
    """`cosim train encoder`. Raises BadInput for invalid input before the first episode."""
    file = configuration(args.config).file
    training, seed, agent = file.sight, args.seed or 0, agent_config("vfn-p", file)
    worlds = [place(w) for w in args.scenario if w != "all"] or list(names())
    announce(
        f"train encoder: {training.updates:,} updates on drives in {', '.join(worlds)}",
        {
            "learning begins": f"when {training.drives} drives of each demand are seen, and "
            f"{training.validation} for validation",
            "curves": curves(shlex.quote(args.out), "log.csv"),
        },
    )
    with working_in(args.out) as folder:
        keep_freed_memory()
        use_threads(args.threads)
        seen = gather(agent, worlds, TRAINING_SEEDS[: training.drives], args.workers, "learns from")
        checked = gather(agent, worlds, TUNING_SEEDS[: training.validation], args.workers, "checks on")
        encoder = encoder_of(file)
        task = SightTask(encoder, training.updates, seed, seen, checked, args.device)
        about = {
            "scenarios": worlds,
            "frames": {"training": len(seen.maps), "validation": len(checked.maps)},
            "sight": asdict(training),
            "seed": seed,
        }
        layout = {"encoder": asdict(encoder), **about}
        with Progress("train encoder", "updates") as progress:
            log = supervised.train(
                task,
                LoopConfig.of(training.updates),
                folder,
                layout=layout,
                resume=args.resume,
                progress=progress,
            )
        weights = folder / "encoder.safetensors"
        explained = sight.explained(checked.readings, sight.read_all(task.network, checked.maps, args.device))
        measured = {"R2 on tuning seeds": {name: round(value, 3) for name, value in explained.items()}}
        sight.save(weights, task.network, measured, about)
        supervised.write_log(weights.with_suffix(".csv"), log)
        for name, value in explained.items():
            print(f"  {value:6.2f}  {name}")
        print(f"encoder: {training.updates} updates on {len(seen.maps):,} frames")
        print(f"  {weights}")
        return 0
