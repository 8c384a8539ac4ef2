"""The two trainers: DDQN learns off-policy from the replay buffer, A2C on-policy from the latest drives.

Both learn from demonstrations first, where their configuration wants it.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cosim.errors import BadInput
from cosim.seeding import generator, subseed
from policy import checkpoint
from policy.networks.extractors import EncodedMaps
from policy.networks.vfn import VfnConfig
from policy.training.a2c import A2cLearner
from policy.training.curriculum import VfnTraining, interpolated, judged
from policy.training.ddqn import DdqnLearner
from policy.training.experience import Trajectory
from policy.training.learner import Learner, Metrics, mean_metrics
from policy.training.replay_buffer import ReplayBuffer
from policy.training.sight import encoder


class Trainer:
    """One learner and its replay buffer; `TrainingRun` asks it in every iteration `k`.

    Args:
        config: the schedule.
        vfn: layout of the network.
        learner: what is trained.
        device: of torch.
    """

    keeps = True  # whether the trajectories of this iteration join the replay buffer

    def __init__(self, config: VfnTraining, vfn: VfnConfig, learner: Learner, device: str) -> None:
        self.config, self.learner, self.device = config, learner, device
        self.kinematic = vfn.kinematic
        self.replay = ReplayBuffer(config.replay)

    def epsilon(self, k: int) -> float:
        """Share of random actions."""
        return interpolated(self.config, self.config.epsilon, k)

    def guided(self, k: int) -> float:
        """Share of the episodes that the demonstrator drives."""
        raise NotImplementedError

    def learn_meanwhile(self, k: int) -> Metrics:
        """Learn what does not wait for this iteration's trajectories."""
        return {}

    def learn_afterwards(self, k: int, drives: Sequence[Trajectory], kept: bool) -> Metrics:
        """Learn from these trajectories, which are in the replay buffer if they were `kept`."""
        return {}

    @property
    def _prefilling(self) -> bool:
        """Whether the replay buffer holds less than is wanted before anything is learned."""
        return self.replay.size < self.config.recorded_first

    def _imitate(self, rng: np.random.Generator, maps: bool) -> float:
        return self.learner.imitate(self.replay.advised(rng, maps, self.device))

    def _warm_up(self, k: int) -> np.random.Generator:
        """The generator of iteration `k`, after the steps towards the demonstrations alone (with maps for a
        network that has no other input), if these are due."""
        rng = generator(self.config.seed, "replay", str(k))
        if not self.learner.updates and self.learner.imitates:
            for _ in range(self.config.warm_up):
                self._imitate(rng, not self.kinematic)
        return rng


class OffPolicyTrainer(Trainer):
    """P, algorithm 4: fill the replay buffer by chance, imitate, then so many updates an iteration."""

    learner: DdqnLearner

    def epsilon(self, k: int) -> float:
        """Share of random actions: all, while the replay buffer is filled."""
        return 1.0 if self._prefilling and not self.config.first else super().epsilon(k)

    def guided(self, k: int) -> float:
        """Share of the episodes that the demonstrator drives."""
        return interpolated(self.config, self.config.guided, k)

    def learn_meanwhile(self, k: int) -> Metrics:
        """This iteration's updates, on what the replay buffer holds."""
        if self._prefilling:
            return {}
        learner, rng = self.learner, self._warm_up(k)
        learner.rate = rate(self.config, k)
        if not learner.updates:
            learner.update_target()
        losses, agrees = [], []
        for _ in range(self.config.updates):
            losses.append(learner.update(self.replay.sample(rng, self.device)))
            if learner.imitates and self.kinematic:  # without kinematics an update costs no more
                agrees.append(self._imitate(rng, False))
        effects = {}
        if judged(self.config, k):  # what the network looks at, while it learns
            past = self.replay.trajectories[0].past
            found = learner.effects(self.replay.sample(rng, self.device), past)
            effects = {f"effect/{name}": value for name, value in found.items()}
        return _named(mean_metrics(losses)) | ({"agrees": float(np.mean(agrees))} if agrees else {}) | effects


def rate(config: VfnTraining, k: int) -> float:
    """Learning rate of iteration `k`: falls linearly over the last third, where it has a last value."""
    c, share = config.ddqn, 3.0 * (k + 1) / config.iterations - 2.0
    last = c.learning_rate if c.last_rate is None else c.last_rate
    return c.learning_rate + (last - c.learning_rate) * min(max(share, 0.0), 1.0)


class OnPolicyTrainer(Trainer):
    """T's A2C: an iteration learns from its own trajectories. Demonstrations are kept until all are there."""

    learner: A2cLearner

    def epsilon(self, k: int) -> float:
        """All of its actions are drawn from the network's preferences."""
        return 1.0

    def guided(self, k: int) -> float:
        """Share of the episodes that the demonstrator drives."""
        return float(self.keeps)

    @property
    def keeps(self) -> bool:  # type: ignore[override]
        """Whether more demonstrations are wanted; without any the replay buffer stays empty."""
        return self.learner.imitates and self._prefilling

    def learn_afterwards(self, k: int, drives: Sequence[Trajectory], kept: bool) -> Metrics:
        """Learn from its own trajectories; after the last demonstration, the steps towards all of them."""
        if not kept:
            return _named(self.learner.learn(drives, generator(self.config.seed, "order", str(k))))
        if not self.keeps:
            self._warm_up(k)
        return {}


def make_trainer(config: VfnTraining, vfn: VfnConfig, device: str) -> Trainer:
    """The one of `config.learning`. Raises BadInput, WeightsMismatch for weights to begin with."""
    seed = subseed(config.seed, "network") % 2**31
    trainer: Trainer
    if config.learning == "a2c":
        trainer = OnPolicyTrainer(config, vfn, A2cLearner(vfn, config.a2c, seed, device), device)
    else:
        trainer = OffPolicyTrainer(config, vfn, DdqnLearner(vfn, config.ddqn, seed, device), device)
    online = trainer.learner.online
    if isinstance(online.maps, EncodedMaps):
        if not config.encoder:
            raise BadInput("an encoder that was taught to see is needed", field="training.encoder", value="")
        online.maps.encoder.load_state_dict(encoder(config.encoder, online.maps.encoder.config))
    if config.first:
        checkpoint.load(Path(config.first), {"vfn": online}, {"vfn": vfn})
    if isinstance(trainer, OnPolicyTrainer) and config.a2c.anchor:
        trainer.learner.remember()
    return trainer


def _named(metrics: Metrics) -> Metrics:
    return {f"loss/{name}": value for name, value in metrics.items()}
