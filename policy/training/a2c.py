"""Multi-agent advantage actor-critic after T: shared weights, n-step returns, passes over fresh drives."""

import copy
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cosim.errors import in_range
from cosim.types import Floats32
from policy.inputs.situation import comes_next
from policy.inputs.tensors import States
from policy.training.experience import Trajectory, states
from policy.training.learner import Learner, Metrics, mean_metrics
from policy.training.replay_buffer import Advised


@dataclass(frozen=True, slots=True)
class A2cConfig:
    """Optimisation. T gives none of these: usual values."""

    learning_rate: float = 3e-4
    weight_decay: float = 0.0  # of AdamW: what every weight loses of itself in an update, times the rate
    attempts: int = 1  # drives of the same traffic by the same learners; the others' mean is the baseline
    # share of the draws that are even over all actions, so that what is not preferred is tried too. They are
    # learned from as if drawn by preference; from an advantage below 0 of an action whose chance is below a
    # fifth of the floor nothing is
    floor: float = 0.0
    # weight of the distance (KL) to `training.first`, for AVs that do not come next to a mission vehicle, or
    # are more than 200 m behind it (with `explore.next`)
    anchor: float = 0.0
    keep: int = 1  # decisions that what is drawn is kept: nobody opens a gap within one of 0.4 s
    n_step: int = 8  # as the DDQN's (docs/guides/training.md); 1 is the papers'
    gamma: float = 0.97  # a decision of 0.4 s
    batch: int = 64
    passes: int = 1  # over what an iteration drove; 1 is A2C
    entropy: float = 0.01  # keeps the policy from closing up early
    critic: float = 0.5  # weight of the value loss
    scale: float = 0.1  # of all rewards, as the DDQN's
    normalize: bool = False  # advantages to mean 0 and deviation 1 over a batch
    clip: float = 0.5  # largest gradient norm
    far: float = 1.0  # weight, for the actor, of decisions that do not count as interaction (`explore.near`)
    imitation: float = 0.0  # weight of the demonstrations: the chance of a demonstrated action is to be 1

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(
            self,
            positive="learning_rate attempts keep n_step gamma batch passes scale clip",
            not_negative="weight_decay imitation far anchor",
            share="floor",
        )


class A2cLearner(Learner):
    """Actor and critic over one extractor, with their optimiser."""

    config: A2cConfig

    def imitate(self, batch: Advised) -> float:
        """See `Learner.imitate`; returns the mean chance of the demonstrated actions."""
        preference, _ = self.online.actor_critic(*batch.now)
        loss = _misfit(preference.log_softmax(1), batch.wrong)
        self.step(loss)
        return float((-loss.detach()).exp())

    def learn(self, drives: Sequence[Trajectory], rng: np.random.Generator) -> Metrics:
        """`config.passes`, each in random order, over trajectories driven with the present weights.

        Of `config.keep` decisions with the same drawn action the first is learned from. With an anchor what
        was drawn is what counts as interaction (`explore.next`), and as many other states are held to it.

        Returns the means of `policy`, `value`, `entropy` (nat), `imitation` (minus the log of the chance of
        the demonstrated actions) and `moved` (nat, what the anchor holds), and `explained_variance`, the
        share of the returns' variance that the critic, or the mean of the other attempts, had foretold;
        nothing when there are no transitions.
        """
        c = self.config
        drawn = [(t, self._draws(t)) for t in drives]
        places = [(t, int(k)) for t, begins in drawn for k in begins]
        if not places:
            return {}
        known = [self._returns(t, begins) for t, begins in drawn if len(begins)]
        returns, foretold = (np.concatenate(part) for part in zip(*known, strict=True))
        if c.attempts > 1:
            # of the same AV in the same traffic its first draws, its second ones, ..., at whatever times
            alike = defaultdict(list)
            which = ((t.episode, t.av, k) for t, begins in drawn for k in range(len(begins)))
            for i, key in enumerate(which):
                alike[key].append(i)
            for rows in alike.values():
                if len(rows) > 1:
                    foretold[rows] = (returns[rows].sum() - returns[rows]) / (len(rows) - 1)
        others: list[tuple[Trajectory, int]] = []
        if c.anchor:
            others = [(t, int(k)) for t in drives for k in np.flatnonzero(~comes_next(t.situation[:-1]))]
        losses = [
            self._update(
                [places[i] for i in rows],
                returns[rows],
                foretold[rows],
                [others[i] for i in rng.integers(len(others), size=len(rows))] if others else [],
            )
            for _ in range(c.passes)
            for rows in _batches(rng.permutation(len(places)), c.batch)
        ]
        explained = 1.0 - float((returns - foretold).var()) / max(float(returns.var()), 1e-12)
        return mean_metrics(losses) | {"explained_variance": explained}

    def remember(self) -> None:
        """What the network is now is what the anchor holds it to."""
        self._began = copy.deepcopy(self.online).eval()

    def _draws(self, drive: Trajectory) -> np.ndarray:
        """The decisions [K] at which an action was drawn, not kept."""
        if self.config.anchor:
            return np.flatnonzero(drive.interacting)
        return np.arange(0, len(drive), self.config.keep)

    def _returns(self, drive: Trajectory, begins: np.ndarray) -> tuple[Floats32, Floats32]:
        """Of the decisions `begins` [K]: n-step returns, bootstrapped by the critic unless the drive ended in
        a crash before; and what the critic foretold."""
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

    def _update(
        self,
        places: list[tuple[Trajectory, int]],
        returns: Floats32,
        foretold: Floats32,
        others: list[tuple[Trajectory, int]],
    ) -> Metrics:
        c, device = self.config, self.device
        action = torch.tensor([int(t.action[k]) for t, k in places], device=device)
        goal = torch.from_numpy(returns).to(device)
        preference, value = self.online.actor_critic(*self._states(places))
        logs = preference.log_softmax(1)
        advantage = goal - (torch.from_numpy(foretold).to(device) if c.attempts > 1 else value.detach())
        weight = torch.tensor([1.0 if t.interacting[k] else c.far for t, k in places], device=device)
        if c.normalize and len(advantage) > 1:
            share = weight / weight.sum().clamp(min=1e-6)
            mean = (share * advantage).sum()
            variance = (share * (advantage - mean).square()).sum() * len(share) / (len(share) - 1)
            advantage = (advantage - mean) / (variance.sqrt() + 1e-6)
        chance = logs.gather(1, action[:, None])[:, 0]  # log
        weight = weight * ~((advantage < 0.0) & (chance.exp() < c.floor / logs.shape[1]))
        entropy = -(logs.exp() * logs).sum(1)
        wrong = torch.from_numpy(np.stack([t.wrong[k] for t, k in places])).to(device)
        losses = {
            "policy": -(weight * advantage * chance).mean(),
            "value": (goal - value).square().mean(),
            "entropy": entropy.mean(),
            "imitation": _misfit(logs, wrong),
            "moved": self._moved(others) if others else logs.new_zeros(()),
        }
        actor = losses["policy"] + c.critic * losses["value"] - c.entropy * (weight * entropy).mean()
        self.step(actor + c.imitation * losses["imitation"] + c.anchor * losses["moved"])
        self.updates += 1
        return {name: float(loss.detach()) for name, loss in losses.items()}

    def _moved(self, places: list[tuple[Trajectory, int]]) -> torch.Tensor:
        """How far the preferences are from what they began as (KL, nat), mean."""
        at = self._states(places)
        with torch.no_grad():
            began = self._began.actor_critic(*at)[0].log_softmax(1)
        now = self.online.actor_critic(*at)[0].log_softmax(1)
        return (began.exp() * (began - now)).sum(1).mean()

    def _states(self, places: list[tuple[Trajectory, int]]) -> States:
        phi = np.array([t.phi for t, _ in places], np.float32)
        return states(places, phi, self.device)


def _misfit(logs: torch.Tensor, wrong: torch.Tensor) -> torch.Tensor:
    """Minus the log of the chance of the demonstrated actions, mean; 0 where nothing was demonstrated."""
    return -logs.masked_fill(wrong, -torch.inf).logsumexp(1).mean()


def _batches(order: np.ndarray, size: int) -> Iterator[np.ndarray]:
    for start in range(0, len(order), size):
        yield order[start : start + size]
