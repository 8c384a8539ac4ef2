"""Several networks learn from one replay buffer; one is taught their mean.

Networks that begin with the same weights and learn from the same drives err in different places: the mean of
their values drives better than each (docs/training.md). Deciding with all of them costs as often as much; so
a network that begins as they did is taught the mean (distillation of an ensemble).
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from cosim.errors import BadInput
from cosim.seeding import generator, subseed
from policy import checkpoint
from policy.networks.vfn import VFN, VfnConfig
from policy.training.curriculum import VfnTraining
from policy.training.ddqn import DdqnLearner
from policy.training.learner import Metrics, mean_metrics
from policy.training.replay_buffer import ReplayBuffer
from policy.training.trainers import make_trainer, rate

RESULT = "distilled.safetensors"
DIFFERENCES = 10.0  # what an error in the difference of two actions counts more than one in the state's value


class Ensemble:
    """Learns in `folder`, one network after the other; those that are finished are read again.

    Args:
        config: the schedule of the training; its part `ensemble` is what is done here.
        vfn: layout of the networks.
        replay: what the training drove.
        folder: of the networks' weights, and of the one that was taught (`RESULT`).
        about: what the cards of the weights say besides.
        device: of torch.
    """

    def __init__(
        self,
        config: VfnTraining,
        vfn: VfnConfig,
        replay: ReplayBuffer,
        folder: Path,
        about: dict[str, Any],
        device: str = "cpu",
    ) -> None:
        self.config, self.vfn, self.replay, self.folder = config, vfn, replay, folder
        self._about, self._device = {**about, "training": asdict(config)}, device

    def run(self, progress: Callable[[float, float], None] | None = None) -> Path:
        """All of it; the file of the network that was taught.

        Raises BadInput when the folder holds an ensemble of another configuration.
        """
        c = self.config.ensemble
        total = c.networks * c.updates + c.distillation

        def shown(done: int) -> None:
            if progress is not None:
                progress(done, total)

        networks = [self._network(k, shown) for k in range(c.networks)]
        path = self.folder / RESULT
        if not self._finished(path):
            pupil = self._learner("pupil")
            measured = self._taught(pupil, networks, lambda k: shown(c.networks * c.updates + k))
            checkpoint.save(path, {"vfn": pupil.online}, {"vfn": self.vfn}, measured, self._about)
        shown(total)
        return path

    def _network(self, k: int, shown: Callable[[int], None]) -> VFN:
        """The `k`-th network, learned from the replay buffer or read."""
        c, path = self.config.ensemble, self.folder / f"network-{k}.safetensors"
        learner = self._learner(str(k))
        if self._finished(path):
            checkpoint.load(path, {"vfn": learner.online}, {"vfn": self.vfn})
            return learner.online
        learner.update_target()
        rng, schedule = generator(self.config.seed, "ensemble", str(k)), self._schedule(c.updates)
        losses = []
        for update in range(c.updates):
            learner.rate = rate(schedule, update)
            batch = self.replay.sample(rng, self._device)
            losses.append(learner.update(batch, self.replay.compared(rng, self._device)))
            shown(k * c.updates + update)
        measured = mean_metrics(losses[-max(c.updates // 10, 1) :])
        checkpoint.save(path, {"vfn": learner.online}, {"vfn": self.vfn}, measured, self._about)
        return learner.online

    def _taught(self, pupil: DdqnLearner, networks: list[VFN], shown: Callable[[int], None]) -> Metrics:
        """Teach it the mean; how well it knows it, over the last tenth of the updates (`lesson`)."""
        c = self.config.ensemble
        rng, schedule = generator(self.config.seed, "distillation"), self._schedule(c.distillation)
        known = []
        for update in range(c.distillation):
            batch = self.replay.advised(rng, True, self._device)
            with torch.no_grad():
                mean = torch.stack([network.apart(*batch.now) for network in networks]).mean(0)
            loss, found = lesson(pupil.online, mean, batch.now, batch.possible)
            pupil.step(loss, rate(schedule, update))
            known.append(found)
            shown(update)
        return mean_metrics(known[-max(c.distillation // 10, 1) :])

    def _learner(self, name: str) -> DdqnLearner:
        """As the training began, but for the seed of what is drawn."""
        seed = subseed(self.config.seed, f"ensemble/{name}") % 2**31
        learner = make_trainer(replace(self.config, seed=seed), self.vfn, self._device).learner
        assert isinstance(learner, DdqnLearner)
        return learner

    def _schedule(self, updates: int) -> VfnTraining:
        return replace(self.config, iterations=updates)

    def _finished(self, path: Path) -> bool:
        if not path.is_file():
            return False
        if checkpoint.read_card(path)["data"]["training"] != checkpoint.plain(self.config):
            raise BadInput("holds an ensemble of another configuration", file=path)
        return True


def lesson(pupil: VFN, mean: torch.Tensor, now: Any, possible: torch.Tensor) -> tuple[torch.Tensor, Metrics]:
    """Loss of a pupil that is to value as `mean` does.

    Args:
        pupil: who learns.
        mean: [B,parts,A] values.
        now: `States` of B states.
        possible: [B,A] bool, actions that are safe.

    Returns:
        The mean squared error of the state values plus `DIFFERENCES` times that of what one action is worth
        more than another, which is what is driven by and much smaller; and `agrees`, the share of states in
        which the pupil chooses as the mean does, and `lost`, what its choice is worth less on average.
    """
    mine = pupil.apart(*now)
    error = mine - mean
    level = error.mean(2, keepdim=True)
    loss = level.square().mean() + DIFFERENCES * (error - level).square().mean()
    with torch.no_grad():
        allowed = possible | ~possible.any(1, keepdim=True)
        theirs, own = (
            pupil.weighed(apart, now[3]).masked_fill(~allowed, -torch.inf) for apart in (mean, mine)
        )
        chosen = theirs.gather(1, own.argmax(1, keepdim=True))[:, 0]
        best = theirs.amax(1)
        found = {"agrees": float((chosen == best).float().mean()), "lost": float((best - chosen).mean())}
    return loss, found
