"""Safe double Q-learning after P's algorithm 4: one update."""

from copy import deepcopy
from dataclasses import dataclass

import torch
from torch.nn import functional

from cosim.errors import in_range
from policy.inputs.situation import ASSISTED
from policy.networks.vfn import VfnConfig
from policy.training.learner import Learner, Metrics
from policy.training.replay_buffer import Advised, Batch


@dataclass(frozen=True, slots=True)
class DdqnConfig:
    """Optimisation. Defaults: P, Table I."""

    learning_rate: float = 5e-4
    last_rate: float | None = None  # of the last iteration, fallen to over the last third; None: constant
    weight_decay: float = 0.0  # of AdamW: what every weight loses of itself in an update, times the rate
    target_every: int = 300  # updates between copies of the online network
    # value of the preferred action that the prioritizer refused: a crash's (Alg. 4, line 13). None: whatever
    # it masks is worth less than the best of what it allows by `margin`, and no more is asked
    r_unsafe: float | None = -5.0
    scale: float = 0.1  # of all rewards: action values of the order of 1
    refused: float = 1.0  # weight of the refused actions' loss
    clip: float = 10.0  # largest gradient norm
    imitation: float = 1.0  # weight of the demonstrations: their action is worth more than any other,
    margin: float = 0.3  # by this much, scaled (large-margin loss of deep Q-learning from demonstrations)

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(
            self,
            positive="learning_rate target_every scale clip",
            not_negative="weight_decay refused imitation margin",
        )
        if self.last_rate is not None:
            in_range(self, positive="last_rate")


class DdqnLearner(Learner):
    """Online and target network with their optimiser."""

    config: DdqnConfig

    def __init__(self, vfn: VfnConfig, config: DdqnConfig, seed: int, device: str = "cpu") -> None:
        super().__init__(vfn, config, seed, device)
        self.target = deepcopy(self.online)
        self._networks["target"] = self.target

    def update(self, batch: Batch) -> Metrics:
        """One step of double Q-learning with masked targets (P, equations 2 and 3; algorithm 4); each part of
        the values learns from its own part of the return.

        Returns `td` (Huber loss of the n-step error), `unsafe` (loss of the refused actions), `imitation`
        (of the demonstrated ones) and `q` (mean value of the actions carried out).
        """
        c = self.config
        with torch.no_grad():
            best = self.online(*batch.later).masked_fill(~batch.allowed, -torch.inf).argmax(1)
            later = _taken(self.target.apart(*batch.later), best)
            gained = batch.reward[:, None] if self.online.config.parts == 1 else batch.parts
            goal = gained * c.scale + batch.discount[:, None] * later
        apart = self.online.apart(*batch.now)
        td = functional.smooth_l1_loss(_taken(apart, batch.action), goal)
        q = self.online.weighed(apart, batch.now.phi)
        unsafe = self.refused(q, batch.possible) if c.r_unsafe is None else self._crashes(q, batch)
        imitation = c.imitation * self._margin(q, batch.possible, batch.wrong)
        self.step(td + unsafe + imitation, self.rate)
        self.updates += 1
        if self.updates % c.target_every == 0:
            self.update_target()
        losses = {
            "td": td,
            "unsafe": unsafe,
            "imitation": imitation,
            "q": q.gather(1, batch.action[:, None]).mean(),
        }
        return {name: float(value.detach()) for name, value in losses.items()}

    def imitate(self, batch: Advised) -> float:
        """See `Learner.imitate`; returns how often the best valued action is a demonstrated one."""
        q = self.online(*batch.now)
        self.step(self.config.imitation * self._margin(q, batch.possible, batch.wrong))
        choice = q.masked_fill(~batch.possible, -torch.inf).argmax(1, keepdim=True)
        return 1.0 - float(batch.wrong.gather(1, choice).float().mean())

    def effects(self, batch: Batch, past: int) -> Metrics:
        """Shares of the batch in which another choice comes out on top when one input is another sample's.

        Args:
            batch: any samples.
            past: N, the frames of maps and kinematics that were perceived; those behind are predicted.
        """
        now, found = batch.now, {}
        parts = {
            "maps": ("maps", slice(None)),
            "predicted_maps": ("maps", slice(past, None)),
            "kinematics": ("kinematics", slice(None)),
            "predicted_kinematics": ("kinematics", slice(past, None)),
            "situation": ("situation", slice(ASSISTED)),  # not what its car does
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
        """The target network becomes the online one."""
        self.target.load_state_dict(self.online.state_dict())

    def refused(self, q: torch.Tensor, possible: torch.Tensor) -> torch.Tensor:
        """Loss of what the prioritizer masks, which is worth less than the best it allows by `margin`.

        Args:
            q: [B,A] values.
            possible: [B,A] bool, what it allows.
        """
        c = self.config
        allowed = possible | ~possible.any(1, keepdim=True)
        best = q.detach().masked_fill(~allowed, -torch.inf).amax(1, keepdim=True)
        return c.refused * functional.relu(q - best + c.margin)[~allowed].sum() / len(q)

    def _crashes(self, q: torch.Tensor, batch: Batch) -> torch.Tensor:
        """Loss of the preferred actions that the prioritizer refused: each is worth `r_unsafe` (Alg. 4)."""
        c = self.config
        assert c.r_unsafe is not None
        refused = batch.vetoed >= 0
        value = q[refused].gather(1, batch.vetoed[refused][:, None])[:, 0]
        worth = torch.full_like(value, c.r_unsafe * c.scale)
        return c.refused * functional.smooth_l1_loss(value, worth, reduction="sum") / len(q)

    def _margin(self, q: torch.Tensor, possible: torch.Tensor, wrong: torch.Tensor) -> torch.Tensor:
        """Large-margin loss: among what was safe, the best demonstrated action leads the others by `margin`.

        What the prioritizer masks need not be learned a second time.
        """
        advised = wrong.any(1)
        if not bool(advised.any()):
            return q.new_zeros(())
        known, bad = q.masked_fill(~possible, -torch.inf)[advised], wrong[advised]
        lead = (known + self.config.margin * bad).amax(1) - known.masked_fill(bad, -torch.inf).amax(1)
        return lead.sum() / len(q)


def _taken(apart: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """[B,parts] of the values [B,parts,A]: those of each action [B]."""
    return apart.gather(2, action[:, None, None].expand(-1, apart.shape[1], 1))[..., 0]
