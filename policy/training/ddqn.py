"""Safe double Q-learning after P's algorithm 4: one update, and what must be kept to go on exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import nn
from torch.nn import functional

from policy.training.networks import adam_tensors, restore_adam, seeded
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
        imitation = torch.zeros((), device=device)
        advice = torch.from_numpy(batch.advice).to(device)
        advised = advice >= 0
        if c.imitation > 0.0 and bool(advised.any()):
            # among what was safe: what the prioritizer masks need not be learned a second time
            possible = torch.from_numpy(batch.possible).to(device)
            heard, his = q.masked_fill(~possible, -torch.inf)[advised], advice[advised][:, None]
            lead = torch.full_like(heard, c.margin).scatter(1, his, 0.0)
            imitation = ((heard + lead).amax(1) - heard.gather(1, his)[:, 0]).sum() * (c.imitation / len(q))
        self.optimizer.zero_grad(set_to_none=True)
        (td + unsafe + imitation).backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.online.parameters(), c.clip)
        self.optimizer.step()
        self.updates += 1
        if self.updates % c.target_every == 0:
            self.target.load_state_dict(self.online.state_dict())
        return Losses(*(float(x.detach()) for x in (td, unsafe, imitation, chosen.mean())))

    # ---- to go on exactly ----

    def tensors(self) -> dict[str, torch.Tensor]:
        """Networks and optimiser as named tensors."""
        return adam_tensors({"online": self.online, "target": self.target}, self.optimizer)

    def restore(self, tensors: Mapping[str, torch.Tensor], updates: int) -> None:
        """Go on from what `tensors` gave after `updates` updates."""
        restore_adam(tensors, {"online": self.online, "target": self.target}, self.optimizer)
        self.updates = updates
