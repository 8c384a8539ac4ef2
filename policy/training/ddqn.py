"""Safe double Q-learning after P's algorithm 4: one update."""

from copy import deepcopy
from dataclasses import dataclass

import torch
from torch.nn import functional

from cosim.errors import in_range
from policy.networks.vfn import VfnConfig
from policy.training.learner import Learner, Metrics
from policy.training.replay_buffer import Batch


@dataclass(frozen=True, slots=True)
class DdqnConfig:
    """Optimisation. Defaults: P, Table I."""

    learning_rate: float = 5e-4
    target_every: int = 300  # updates between copies of the online network
    r_unsafe: float = -5.0  # reward of a refused preferred action, as of a crash (Alg. 4, line 13)
    scale: float = 0.1  # factor on all rewards, for action values of the order of 1
    refused: float = 1.0  # weight of the refused actions' loss
    clip: float = 10.0  # largest gradient norm

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(self, positive="learning_rate target_every scale clip", not_negative="refused")


class DdqnLearner(Learner):
    """Online and target network with their optimiser."""

    config: DdqnConfig

    def __init__(self, vfn: VfnConfig, config: DdqnConfig, seed: int, device: str = "cpu") -> None:
        super().__init__(vfn, config, seed, device)
        self.target = deepcopy(self.online)
        self._networks["target"] = self.target

    def update(self, batch: Batch) -> Metrics:
        """One step of double Q-learning with masked targets (P, equations 2 and 3; algorithm 4). Each part of
        the values is trained on its part of the return.

        Returns `td` (Huber loss of the n-step error), `unsafe` (loss of the refused actions) and `q` (mean
        value of the actions carried out).
        """
        c = self.config
        with torch.no_grad():
            best = self.online(*batch.later).masked_fill(~batch.allowed, -torch.inf).argmax(1)
            later = _taken(self.target.part_values(*batch.later), best)
            gained = batch.reward[:, None] if self.online.config.parts == 1 else batch.parts
            goal = gained * c.scale + batch.discount[:, None] * later
        apart = self.online.part_values(*batch.now)
        td = functional.smooth_l1_loss(_taken(apart, batch.action), goal)
        q = self.online.weighed(apart, batch.now.phi)
        unsafe = self._refused(q, batch)
        self.step(td + unsafe)
        self.updates += 1
        if self.updates % c.target_every == 0:
            self.update_target()
        losses = {"td": td, "unsafe": unsafe, "q": q.gather(1, batch.action[:, None]).mean()}
        return {name: float(value.detach()) for name, value in losses.items()}

    def effects(self, batch: Batch, past: int) -> Metrics:
        """Shares of the batch with another best action after one input is replaced by another sample's.

        Args:
            batch: any samples.
            past: N, the perceived frames of maps and kinematics; later frames are predicted.
        """
        now, found = batch.now, {}
        parts = {
            "maps": ("maps", slice(None)),
            "predicted_maps": ("maps", slice(past, None)),
            "kinematics": ("kinematics", slice(None)),
            "predicted_kinematics": ("kinematics", slice(past, None)),
            "situation": ("situation", slice(None)),
            "phi": ("phi", slice(None)),
        }
        with torch.no_grad():
            choice = self.online(*now).masked_fill(~batch.possible, -torch.inf).argmax(1)
            for name, (field, span) in parts.items():
                other: torch.Tensor = getattr(now, field).clone()
                other[:, span] = other.roll(1, 0)[:, span]
                q = self.online(*now._replace(**{field: other})).masked_fill(~batch.possible, -torch.inf)
                found[name] = float((q.argmax(1) != choice).float().mean())
        return found

    def update_target(self) -> None:
        """Copy the online network into the target network."""
        self.target.load_state_dict(self.online.state_dict())

    def _refused(self, q: torch.Tensor, batch: Batch) -> torch.Tensor:
        """Loss of preferred actions that the prioritizer refused: their target is `r_unsafe` (Alg. 4)."""
        c = self.config
        refused = batch.vetoed >= 0
        value = q[refused].gather(1, batch.vetoed[refused][:, None])[:, 0]
        worth = torch.full_like(value, c.r_unsafe * c.scale)
        return c.refused * functional.smooth_l1_loss(value, worth, reduction="sum") / len(q)


def _taken(apart: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """[B,parts] values of the actions [B], from [B,parts,A]."""
    return apart.gather(2, action[:, None, None].expand(-1, apart.shape[1], 1))[..., 0]
