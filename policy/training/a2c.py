"""Multi-agent advantage actor-critic after T: shared weights, n-step returns, one pass over fresh drives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from cosim.errors import in_range
from cosim.types import Floats32
from policy.seeded import seeded
from policy.training.experience import Advised, Trajectory, states
from policy.training.networks import adam_tensors, restore_adam
from policy.vfn import VFN, VfnConfig


@dataclass(frozen=True, slots=True)
class A2cConfig:
    """Optimisation. T gives none of these: usual values."""

    learning_rate: float = 3e-4
    n_step: int = 8  # as the DDQN's (docs/training.md); 1 is the papers'
    gamma: float = 0.97  # a decision of 0.4 s
    batch: int = 64
    entropy: float = 0.01  # keeps the policy from closing up early
    critic: float = 0.5  # weight of the value loss
    scale: float = 0.1  # of all rewards, as the DDQN's
    clip: float = 0.5  # largest gradient norm
    imitation: float = 0.0  # weight of the mentor's advice: the chance of what he thinks right is to be 1

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(self, positive="learning_rate n_step gamma batch scale clip", not_negative="imitation")


class A2cLosses(NamedTuple):
    """Means over one pass."""

    policy: float
    value: float
    entropy: float  # nat
    imitation: float  # minus the log of the chance of what the mentor thinks right


class A2cLearner:
    """Actor and critic over one extractor, with their optimiser."""

    def __init__(self, vfn: VfnConfig, config: A2cConfig, seed: int, device: str = "cpu") -> None:
        self.config, self.device = config, device
        self.online: VFN = seeded(lambda: VFN(vfn), seed)
        self.online.to(device=device, memory_format=self.online.layout)  # type: ignore[call-overload]
        self.optimizer = torch.optim.Adam(self.online.parameters(), lr=config.learning_rate)
        self.updates = 0

    @property
    def listens(self) -> bool:
        """Whether the mentor is heard."""
        return self.config.imitation > 0.0

    def imitate(self, batch: Advised) -> float:
        """One step towards the mentor alone; returns the mean chance of what he thinks right."""
        assert batch.maps is not None  # this network has nothing else
        preference, _ = self.online.actor_critic(batch.maps, batch.kinematics, batch.situation, batch.phi)
        loss = _misfit(preference.log_softmax(1), batch.wrong)
        self._descend(loss)
        return float((-loss.detach()).exp())

    def learn(self, drives: Sequence[Trajectory], rng: np.random.Generator) -> A2cLosses | None:
        """One pass over the decisions of `drives`, which were driven with the present weights, in random
        order. None when there are none."""
        places = [(t, k) for t in drives for k in range(len(t))]
        if not places:
            return None
        returns = np.concatenate([self._returns(t) for t in drives if len(t)])
        losses = [
            self._step([places[i] for i in rows], returns[rows])
            for rows in _batches(rng.permutation(len(places)), self.config.batch)
        ]
        return A2cLosses(*(float(v) for v in np.mean(losses, 0)))

    def _returns(self, drive: Trajectory) -> Floats32:
        """n-step returns [D], bootstrapped by the critic unless the drive ended in a crash before."""
        c, d = self.config, len(drive)
        phi = np.full(d + 1, drive.phi, np.float32)
        values = np.empty(d + 1, np.float32)
        with torch.no_grad():
            for rows in _batches(np.arange(d + 1), c.batch):
                _, v = self.online.actor_critic(
                    *states([(drive, int(t)) for t in rows], phi[rows], self.device)
                )
                values[rows] = v.to("cpu").numpy()
        if drive.ending == "crashed":
            values[d] = 0.0
        weights = np.array([np.cos(drive.phi), np.sin(drive.phi), np.sin(drive.phi)], np.float32)
        reward = c.scale * (drive.terms @ weights)  # [D]
        out = np.empty(d, np.float32)
        for t in range(d):
            end = min(t + c.n_step, d)
            out[t] = c.gamma ** np.arange(end - t) @ reward[t:end] + c.gamma ** (end - t) * values[end]
        return out

    def _step(self, places: list[tuple[Trajectory, int]], returns: Floats32) -> A2cLosses:
        c, device = self.config, self.device
        phi = np.array([t.phi for t, _ in places], np.float32)
        action = torch.tensor([int(t.action[k]) for t, k in places], device=device)
        goal = torch.from_numpy(returns).to(device)
        preference, value = self.online.actor_critic(*states(places, phi, device))
        logs = preference.log_softmax(1)
        advantage = (goal - value).detach()
        policy = -(advantage * logs.gather(1, action[:, None])[:, 0]).mean()
        worth = (goal - value).square().mean()
        entropy = -(logs.exp() * logs).sum(1).mean()
        wrong = torch.from_numpy(np.stack([t.wrong[k] for t, k in places])).to(device)
        imitation = _misfit(logs, wrong)
        self._descend(policy + c.critic * worth - c.entropy * entropy + c.imitation * imitation)
        self.updates += 1
        return A2cLosses(*(float(x.detach()) for x in (policy, worth, entropy, imitation)))

    def _descend(self, loss: torch.Tensor) -> None:
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.online.parameters(), self.config.clip)
        self.optimizer.step()

    def tensors(self) -> dict[str, torch.Tensor]:
        """Network and optimiser as named tensors."""
        return adam_tensors({"online": self.online}, self.optimizer)

    def restore(self, tensors: dict[str, torch.Tensor], updates: int) -> None:
        """Go on from what `tensors` gave after `updates` updates."""
        restore_adam(tensors, {"online": self.online}, self.optimizer)
        self.updates = updates


def _misfit(logs: torch.Tensor, wrong: torch.Tensor) -> torch.Tensor:
    """Minus the log of the chance of what the mentor thinks right, mean; 0 where he had no opinion."""
    return -logs.masked_fill(wrong, -torch.inf).logsumexp(1).mean()


def _batches(order: np.ndarray, size: int) -> Iterator[np.ndarray]:
    for start in range(0, len(order), size):
        yield order[start : start + size]
