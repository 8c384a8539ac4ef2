"""The two trainers: DDQN, off-policy from the replay buffer; A2C, on-policy from the latest trajectories."""

from collections.abc import Sequence

from cosim.errors import BadInput
from cosim.seeding import generator, subseed
from policy.networks.extractors import EncodedMaps
from policy.networks.vfn import VfnConfig
from policy.training.a2c import A2cLearner
from policy.training.curriculum import VfnTraining, exploration, is_validated
from policy.training.ddqn import DdqnLearner
from policy.training.experience import Trajectory
from policy.training.learner import Learner, Metrics, mean_metrics
from policy.training.replay_buffer import ReplayBuffer
from policy.training.sight import encoder


class Trainer:
    """One learner and its replay buffer; `TrainingRun` calls it in every iteration `k`.

    Args:
        config: the schedule.
        learner: DDQN or A2C.
        device: of torch.
    """

    stores = True  # whether the trajectories of an iteration join the replay buffer
    keep = 0  # decisions that a drawn action is repeated; 0: epsilon-greedy

    def __init__(self, config: VfnTraining, learner: Learner, device: str) -> None:
        self.config, self.learner, self.device = config, learner, device
        self.replay = ReplayBuffer(config.replay_config)

    def epsilon(self, k: int) -> float:
        """Share of random actions."""
        raise NotImplementedError

    def learn_meanwhile(self, k: int) -> Metrics:
        """Updates that run in parallel with this iteration's episodes."""
        return {}

    def learn_afterwards(self, k: int, drives: Sequence[Trajectory]) -> Metrics:
        """Updates on this iteration's trajectories."""
        return {}


class OffPolicyTrainer(Trainer):
    """P, algorithm 4: fill the replay buffer with random actions, then `updates` updates an iteration."""

    learner: DdqnLearner

    def epsilon(self, k: int) -> float:
        """All actions are random while the replay buffer is filled."""
        return 1.0 if self._prefilling else exploration(self.config, k)

    def learn_meanwhile(self, k: int) -> Metrics:
        """This iteration's updates on the replay buffer."""
        if self._prefilling:
            return {}
        learner, rng = self.learner, generator(self.config.seed, "replay", str(k))
        if not learner.updates:
            learner.update_target()
        losses = [learner.update(self.replay.sample(rng, self.device)) for _ in range(self.config.updates)]
        effects = {}
        if is_validated(self.config, k):  # attribution during training
            past = self.replay.trajectories[0].past
            found = learner.effects(self.replay.sample(rng, self.device), past)
            effects = {f"effect/{name}": value for name, value in found.items()}
        return _named(mean_metrics(losses)) | effects

    @property
    def _prefilling(self) -> bool:
        """Whether the replay buffer is below the prefill."""
        return self.replay.size < self.config.prefill


class OnPolicyTrainer(Trainer):
    """T's A2C: an iteration learns from its own trajectories, without a replay buffer."""

    learner: A2cLearner
    stores = False

    @property
    def keep(self) -> int:  # type: ignore[override]
        """Decisions that an action drawn from the network's preferences is repeated."""
        return self.config.a2c.keep

    def epsilon(self, k: int) -> float:
        """1: all actions are drawn from the network's preferences."""
        return 1.0

    def learn_afterwards(self, k: int, drives: Sequence[Trajectory]) -> Metrics:
        """Updates on this iteration's trajectories."""
        return _named(self.learner.learn(drives, generator(self.config.seed, "order", str(k))))


def make_trainer(config: VfnTraining, vfn: VfnConfig, device: str) -> Trainer:
    """A2C for a network with a critic, else DDQN. Raises BadInput, WeightsMismatch for an encoder."""
    seed = subseed(config.seed, "network") % 2**31
    trainer: Trainer
    if vfn.critic:
        trainer = OnPolicyTrainer(config, A2cLearner(vfn, config.a2c_config, seed, device), device)
    else:
        trainer = OffPolicyTrainer(config, DdqnLearner(vfn, config.ddqn_config, seed, device), device)
    online = trainer.learner.online
    if isinstance(online.maps, EncodedMaps):
        if not config.encoder:
            raise BadInput("an encoder that was taught to see is needed", field="training.encoder", value="")
        online.maps.encoder.load_state_dict(encoder(config.encoder, online.maps.encoder.config))
    return trainer


def _named(metrics: Metrics) -> Metrics:
    return {f"loss/{name}": value for name, value in metrics.items()}
