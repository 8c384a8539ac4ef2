"""Safe double Q-learning after P's algorithm 4: one update, and what must be kept to go on exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import nn
from torch.nn import functional

from cosim.errors import in_range
from policy.seeded import seeded
from policy.training.experience import Advised
from policy.training.networks import adam_tensors, restore_adam
from policy.training.replay import Batch
from policy.vfn import VFN, VfnConfig


@dataclass(frozen=True, slots=True)
class DdqnConfig:
    """Optimisation. Defaults: P, Table I."""

    learning_rate: float = 5e-4
    target_every: int = 300  # updates between copies of the online network
    r_unsafe: float = -5.0  # value of an action that the prioritizer refused: a crash's (Alg. 4, line 13)
    scale: float = 0.1  # of all rewards: action values of the order of 1
    refused: float = 1.0  # weight of the refused actions' loss
    clip: float = 10.0  # largest gradient norm
    imitation: float = 1.0  # weight of the mentor's advice: his action is worth more than any other,
    margin: float = 0.3  # by this much (large-margin loss of deep Q-learning from demonstrations)

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(
            self, positive="learning_rate target_every scale clip", not_negative="refused imitation margin"
        )


class Losses(NamedTuple):
    """Of one update."""

    td: float  # Huber loss of the n-step error
    unsafe: float  # of the refused actions
    imitation: float  # of the mentor's actions
    q: float  # mean value of the actions carried out


class Learner:
    """Online and target network with their optimiser."""

    def __init__(self, vfn: VfnConfig, config: DdqnConfig, seed: int, device: str = "cpu") -> None:
        self.config, self.device = config, device
        self.online: VFN = seeded(lambda: VFN(vfn), seed)
        self.target = VFN(vfn)
        self.target.load_state_dict(self.online.state_dict())
        for network in (self.online, self.target):
            network.to(device=device, memory_format=network.layout)  # type: ignore[call-overload]
        self.optimizer = torch.optim.Adam(self.online.parameters(), lr=config.learning_rate)
        self.updates = 0

    @property
    def listens(self) -> bool:
        """Whether the mentor is heard."""
        return self.config.imitation > 0.0

    def update(self, batch: Batch) -> Losses:
        """One step of double Q-learning (P, equations 2 and 3) with masked targets."""
        c, device = self.config, self.device
        action = torch.from_numpy(batch.action).to(device)
        reward = torch.from_numpy(batch.reward).to(device) * c.scale
        discount = torch.from_numpy(batch.discount).to(device)
        allowed = torch.from_numpy(batch.allowed).to(device)
        vetoed = torch.from_numpy(batch.vetoed).to(device)
        with torch.no_grad():
            best = self.online(*batch.later).masked_fill(~allowed, -torch.inf).argmax(1, keepdim=True)
            goal = reward + discount * self.target(*batch.later).gather(1, best)[:, 0]
        q = self.online(*batch.now)
        chosen = q.gather(1, action[:, None])[:, 0]
        td = functional.smooth_l1_loss(chosen, goal)
        refused = vetoed >= 0
        unsafe = torch.zeros((), device=device)
        if bool(refused.any()):  # stored as terminal with reward r_unsafe (Alg. 4)
            value = q[refused].gather(1, vetoed[refused][:, None])[:, 0]
            worth = torch.full_like(value, c.r_unsafe * c.scale)
            unsafe = functional.smooth_l1_loss(value, worth, reduction="sum") * (c.refused / len(q))
        possible, wrong = (torch.from_numpy(x).to(device) for x in (batch.possible, batch.wrong))
        imitation = c.imitation * self._margin(q, possible, wrong)
        self._step(td + unsafe + imitation)
        self.updates += 1
        if self.updates % c.target_every == 0:
            self.follow()
        return Losses(*(float(x.detach()) for x in (td, unsafe, imitation, chosen.mean())))

    def imitate(self, batch: Advised) -> float:
        """One step towards the mentor alone; returns how often the choice is one of his."""
        q = self.online(batch.maps, batch.kinematics, batch.situation, batch.phi)
        self._step(self.config.imitation * self._margin(q, batch.possible, batch.wrong))
        choice = q.masked_fill(~batch.possible, -torch.inf).argmax(1, keepdim=True)
        return 1.0 - float(batch.wrong.gather(1, choice).float().mean())

    def follow(self) -> None:
        """The target network becomes the online one."""
        self.target.load_state_dict(self.online.state_dict())

    def _margin(self, q: torch.Tensor, possible: torch.Tensor, wrong: torch.Tensor) -> torch.Tensor:
        """Large-margin loss: among what was safe, the mentor's best is to lead what he thinks wrong.

        What the prioritizer masks need not be learned a second time.
        """
        advised = wrong.any(1)
        if not bool(advised.any()):
            return q.new_zeros(())
        heard, bad = q.masked_fill(~possible, -torch.inf)[advised], wrong[advised]
        lead = (heard + self.config.margin * bad).amax(1) - heard.masked_fill(bad, -torch.inf).amax(1)
        return lead.sum() / len(q)

    def _step(self, loss: torch.Tensor) -> None:
        if not loss.requires_grad:
            return  # nobody was advised
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.online.parameters(), self.config.clip)
        self.optimizer.step()

    # ---- to go on exactly ----

    def tensors(self) -> dict[str, torch.Tensor]:
        """Networks and optimiser as named tensors."""
        return adam_tensors({"online": self.online, "target": self.target}, self.optimizer)

    def restore(self, tensors: Mapping[str, torch.Tensor], updates: int) -> None:
        """Go on from what `tensors` gave after `updates` updates."""
        restore_adam(tensors, {"online": self.online, "target": self.target}, self.optimizer)
        self.updates = updates
