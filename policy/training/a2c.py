"""Multi-agent advantage actor-critic after T: shared weights, n-step returns, passes over fresh drives."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cosim.errors import in_range
from cosim.types import Floats32
from policy.training.experience import Trajectory, states
from policy.training.learner import Learner, Metrics, mean_metrics


@dataclass(frozen=True, slots=True)
class A2cConfig:
    """Optimisation. T gives none of these: usual values."""

    learning_rate: float = 3e-4
    keep: int = 1  # decisions that a drawn action is repeated: a gap takes longer than one of 0.4 s
    n_step: int = 8  # as for DDQN (docs/guides/training.md); the papers: 1
    gamma: float = 0.97  # a decision of 0.4 s
    batch: int = 64
    passes: int = 1  # over an iteration's trajectories; 1 is A2C
    entropy: float = 0.01  # weight, against premature convergence
    critic: float = 0.5  # weight of the value loss
    scale: float = 0.1  # factor on all rewards, as for DDQN
    normalize: bool = False  # advantages to mean 0 and deviation 1 over a batch
    clip: float = 0.5  # largest gradient norm

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(
            self,
            positive="learning_rate keep n_step gamma batch passes scale clip",
            not_negative="entropy critic",
        )


class A2cLearner(Learner):
    """Actor and critic on a shared extractor, with their optimiser."""

    config: A2cConfig

    def learn(self, drives: Sequence[Trajectory], rng: np.random.Generator) -> Metrics:
        """`config.passes`, each in random order, over trajectories driven with the present weights.

        Of `config.keep` decisions with the same drawn action only the first is a sample.

        Returns the means of `policy`, `value` and `entropy` (nat), and `explained_variance`, the share of the
        returns' variance that the critic predicted; empty without transitions.
        """
        c = self.config
        drawn = [(t, np.arange(0, len(t), c.keep)) for t in drives]
        places = [(t, int(k)) for t, begins in drawn for k in begins]
        if not places:
            return {}
        known = [self._returns(t, begins) for t, begins in drawn if len(begins)]
        returns, foretold = (np.concatenate(part) for part in zip(*known, strict=True))
        losses = [
            self._update([places[i] for i in rows], returns[rows])
            for _ in range(c.passes)
            for rows in _batches(rng.permutation(len(places)), c.batch)
        ]
        explained = 1.0 - float((returns - foretold).var()) / max(float(returns.var()), 1e-12)
        return mean_metrics(losses) | {"explained_variance": explained}

    def _returns(self, drive: Trajectory, begins: np.ndarray) -> tuple[Floats32, Floats32]:
        """For the decisions `begins` [K]: n-step returns, bootstrapped by the critic unless the episode ended
        in a crash before; and the critic's values."""
        c, d = self.config, len(drive)
        ends = np.minimum(begins + c.n_step, d)
        asked = np.union1d(begins, ends)
        phi = np.full(len(asked), drive.phi, np.float32)
        values = np.zeros(d + 1, np.float32)
        with torch.no_grad():
            for rows in _batches(np.arange(len(asked)), c.batch):
                places = [(drive, int(t)) for t in asked[rows]]
                _, v = self.online.actor_critic(*states(places, phi[rows], self.device))
                values[asked[rows]] = v.to("cpu").numpy()
        if drive.ending == "crashed":
            values[d] = 0.0
        weights = np.array([np.cos(drive.phi), np.sin(drive.phi), np.sin(drive.phi)], np.float32)
        reward = c.scale * (drive.terms @ weights)  # [D]
        out = np.empty(len(begins), np.float32)
        for i, (t, end) in enumerate(zip(begins, ends, strict=True)):
            out[i] = c.gamma ** np.arange(end - t) @ reward[t:end] + c.gamma ** (end - t) * values[end]
        return out, values[begins]

    def _update(self, places: list[tuple[Trajectory, int]], returns: Floats32) -> Metrics:
        c, device = self.config, self.device
        action = torch.tensor([int(t.action[k]) for t, k in places], device=device)
        goal = torch.from_numpy(returns).to(device)
        phi = np.array([t.phi for t, _ in places], np.float32)
        preference, value = self.online.actor_critic(*states(places, phi, device))
        logs = preference.log_softmax(1)
        advantage = goal - value.detach()
        if c.normalize and len(advantage) > 1:
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        losses = {
            "policy": -(advantage * logs.gather(1, action[:, None])[:, 0]).mean(),
            "value": (goal - value).square().mean(),
            "entropy": -(logs.exp() * logs).sum(1).mean(),
        }
        self.step(losses["policy"] + c.critic * losses["value"] - c.entropy * losses["entropy"])
        self.updates += 1
        return {name: float(loss.detach()) for name, loss in losses.items()}


def _batches(order: np.ndarray, size: int) -> Iterator[np.ndarray]:
    for start in range(0, len(order), size):
        yield order[start : start + size]
