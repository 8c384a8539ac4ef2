"""Replay buffer of whole trajectories: n-step samples, a fixed share of them from interactions."""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from cosim.errors import in_range
from cosim.types import Ints
from policy.inputs.tensors import States
from policy.training.experience import Trajectory, states


@dataclass(frozen=True, slots=True)
class ReplayConfig:
    """Capacity and sampling of the replay buffer."""

    capacity: int = 30_000  # decisions of 0.1 MB; P's 8,000 (Table I) are 20 episodes of 4 learners
    batch: int = 64  # P, Table I
    n_step: int = 8  # with 1 (the papers) no altruism was learned (docs/guides/training.md)
    gamma: float = 0.97  # per decision of 0.4 s; P: 0.95
    # share of a batch near a mission vehicle, or vetoed, regardless of frequency (P, Alg. 4: rebalanced)
    interaction: float = 0.25
    relabel: float = 0.5  # share of a batch relabelled with another SVO, 0 to 90 deg

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(self, positive="capacity batch n_step gamma", share="interaction relabel")


class Batch(NamedTuple):
    """B transitions; `reward` is the discounted n-step return so far."""

    now: States
    later: States
    action: torch.Tensor  # [B]
    reward: torch.Tensor  # [B] float32
    discount: torch.Tensor  # [B] gamma^k of the state `later`; 0 after a crash
    possible: torch.Tensor  # [B,A] bool, safe actions in `now`
    allowed: torch.Tensor  # [B,A] bool, safe actions in `later` (all, if none was safe)
    vetoed: torch.Tensor  # [B] the action the prioritizer refused in `now`, or -1
    parts: torch.Tensor  # [B,2] the ego's and the others' part of the return, not weighted by phi


class ReplayBuffer:
    """The newest trajectories, up to `capacity` decisions."""

    def __init__(self, config: ReplayConfig) -> None:
        self.config = config
        self.trajectories: deque[Trajectory] = deque()
        self.size = 0
        self._index: list[Ints] | None = None  # [*,2] (trajectory, t): the interactions, then the rest

    def add(self, trajectories: list[Trajectory]) -> int:
        """Store trajectories; returns the number of dropped oldest ones."""
        self.trajectories.extend(t for t in trajectories if len(t))
        self.size += sum(map(len, trajectories))
        dropped = 0
        while self.size > self.config.capacity and len(self.trajectories) > 1:
            self.size -= len(self.trajectories.popleft())
            dropped += 1
        self._index = None
        return dropped

    def sample(self, rng: np.random.Generator, device: str = "cpu") -> Batch:
        """One batch, drawn by `rng`, on torch's `device`. Raises ValueError while nothing is stored."""
        c = self.config
        now = self._picks(rng, c.batch)
        phi = np.array([t.phi for t, _ in now], np.float32)
        fresh = np.radians(rng.uniform(0.0, 90.0, len(now))).astype(np.float32)
        phi = np.where(rng.random(len(now)) < c.relabel, fresh, phi)
        weights = np.stack([np.cos(phi), np.sin(phi), np.sin(phi)], 1)  # [B,3] of the reward's terms
        later = [(trajectory, min(t + c.n_step, len(trajectory))) for trajectory, t in now]
        reward, discount = np.zeros((2, len(now)), np.float32)
        parts = np.zeros((len(now), 2), np.float32)
        for b, ((trajectory, t), (_, end)) in enumerate(zip(now, later, strict=True)):
            fading, terms = c.gamma ** np.arange(end - t), trajectory.terms[t:end]
            reward[b] = fading @ (terms @ weights[b])
            parts[b] = fading @ terms[:, 0], fading @ terms[:, 1:].sum(1)
            if end < len(trajectory) or trajectory.ending != "crashed":
                discount[b] = c.gamma ** (end - t)
        safe = ~np.stack([trajectory.unsafe[t] for trajectory, t in later])
        arrays = (
            np.array([trajectory.action[t] for trajectory, t in now], np.int64),
            reward,
            discount,
            ~np.stack([trajectory.unsafe[t] for trajectory, t in now]),
            safe | ~safe.any(1, keepdims=True),
            np.array([trajectory.vetoed[t] for trajectory, t in now], np.int64),
            parts,
        )
        tensors = (torch.from_numpy(array).to(device) for array in arrays)
        return Batch(states(now, phi, device), states(later, phi, device), *tensors)

    def _picks(self, rng: np.random.Generator, count: int) -> list[tuple[Trajectory, int]]:
        """`count` pairs (trajectory, t), with replacement, in the configured shares."""
        if not self.size:
            raise ValueError("the replay buffer is empty")
        share = self.config.interaction
        shares = (share, 1.0 - share)
        groups = [(p, share) for p, share in zip(self._places(), shares, strict=True) if len(p)]
        edges = np.cumsum([0.0] + [share for _, share in groups])
        counts = np.diff(np.round(count * edges / edges[-1]).astype(int)) if edges[-1] else [count]
        drawn = [
            places[rng.integers(len(places), size=int(k))]
            for (places, _), k in zip(groups, counts, strict=False)
            if k
        ]
        return [(self.trajectories[k], int(t)) for k, t in np.concatenate(drawn)]

    def _places(self) -> list[Ints]:
        if self._index is None:
            places = [(k, t) for k, one in enumerate(self.trajectories) for t in range(len(one))]
            every = np.array(places, np.int64).reshape(-1, 2)
            near = np.concatenate([t.interacting for t in self.trajectories])
            self._index = [every[near], every[~near]]
        return self._index
