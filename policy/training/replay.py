"""Replay of whole trajectories: n-step samples, in fixed parts from the rare moments and the common ones."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.errors import BadInput
from cosim.types import Bools, Floats32, Ints, MetaAction
from policy.tensors import States
from policy.training.experience import Advised, Trajectory, advised, states


@dataclass(frozen=True, slots=True)
class ReplayConfig:
    """What is kept and how it is drawn."""

    capacity: int = 30_000  # decisions; P's 8,000 (Table I) are 20 episodes of 4 learners. 0.1 MB each
    batch: int = 64  # P, Table I
    advised: int = 64  # states on which the mentor alone speaks; with maps `batch`, for they cost as much
    n_step: int = 8  # one step did not learn altruism (docs/training.md); 1 is the papers'
    gamma: float = 0.97  # a decision of 0.4 s; P: 0.95
    # shares of a batch, however rare such moments are (P, Alg. 4: rebalanced):
    yielding: float = 0.25  # where the mentor would have yielded; one AV in ten does, for some seconds
    correcting: float = 0.0  # where going on as commanded is wrong in the mentor's eyes
    interaction: float = 0.25  # near a mission vehicle, or vetoed
    relabel: float = 0.5  # share of a batch that is learned for another SVO than it was driven with
    phi: tuple[float, float] = (0.0, 90.0)  # deg, what relabelling draws from; equal bounds: one SVO only

    def __post_init__(self) -> None:
        """Raises BadInput when the shares leave nothing to share."""
        if min(self.rare) < 0.0 or sum(self.rare) > 1.0:
            problem = "must be shares of a batch: none below 0, together at most 1"
            raise BadInput(problem, field="yielding, correcting, interaction", value=self.rare)

    @property
    def rare(self) -> tuple[float, float, float]:
        """The shares of `yielding`, `correcting` and `interaction`."""
        return self.yielding, self.correcting, self.interaction


class Batch(NamedTuple):
    """B samples; `reward` is the discounted n-step return so far."""

    now: States
    later: States
    action: Ints  # [B]
    reward: Floats32  # [B]
    discount: Floats32  # [B] gamma^k of the state `later`; 0 when the AV crashed before it
    possible: Bools  # [B,A] actions that were safe in `now`
    allowed: Bools  # [B,A] actions that were safe in `later` (all, where none was)
    vetoed: Ints  # [B] the action the prioritizer refused in `now`, or -1
    wrong: Bools  # [B,A] what the mentor would not have done in `now` (he speaks for the drive's SVO alone)


class Replay:
    """Newest trajectories up to `capacity` decisions."""

    def __init__(self, config: ReplayConfig) -> None:
        self.config = config
        self.trajectories: deque[Trajectory] = deque()
        self.size = 0
        self._index: list[Ints] | None = None  # [*,2] (trajectory, t): the rare moments, then the rest

    def add(self, trajectories: list[Trajectory]) -> int:
        """Store them; returns how many of the oldest were dropped."""
        self.trajectories.extend(t for t in trajectories if len(t))
        self.size += sum(map(len, trajectories))
        dropped = 0
        while self.size > self.config.capacity and len(self.trajectories) > 1:
            self.size -= len(self.trajectories.popleft())
            dropped += 1
        self._index = None
        return dropped

    def sample(self, rng: np.random.Generator, device: str = "cpu") -> Batch:
        """One batch. Raises ValueError while nothing is stored."""
        if not self.size:
            raise ValueError("the replay is empty")
        c = self.config
        picks = self._picks(rng, c.batch)
        phi = np.array([self.trajectories[k].phi for k, _ in picks], np.float32)
        fresh = np.radians(rng.uniform(*c.phi, len(picks))).astype(np.float32)
        relabelled = rng.random(len(picks)) < c.relabel
        wrong = np.stack([self.trajectories[k].wrong[t] for k, t in picks]) & ~relabelled[:, None]
        return self._batch(picks, np.where(relabelled, fresh, phi), wrong, device)

    def advised(self, rng: np.random.Generator, with_maps: bool, device: str = "cpu") -> Advised:
        """States for the mentor alone to speak on. Raises ValueError while nothing is stored."""
        if not self.size:
            raise ValueError("the replay is empty")
        picks = self._picks(rng, self.config.batch if with_maps else self.config.advised)
        return advised([(self.trajectories[k], int(t)) for k, t in picks], with_maps, device)

    def _picks(self, rng: np.random.Generator, count: int) -> Ints:
        """[count,2] places, in the configured parts."""
        rare = self.config.rare
        shares = (*rare, 1.0 - sum(rare))
        groups = [(p, share) for p, share in zip(self._places(), shares, strict=True) if len(p)]
        edges = np.cumsum([0.0] + [share for _, share in groups])
        counts = np.diff(np.round(count * edges / edges[-1]).astype(int)) if edges[-1] else [count]
        drawn = [_draw(places, int(k), rng) for (places, _), k in zip(groups, counts, strict=False)]
        return np.concatenate(drawn)

    def _batch(self, picks: Ints, phi: Floats32, wrong: Bools, device: str) -> Batch:
        c = self.config
        weights = np.stack([np.cos(phi), np.sin(phi), np.sin(phi)], 1)  # [B,3] of the reward's terms
        reward = np.zeros(len(picks), np.float32)
        discount = np.zeros(len(picks), np.float32)
        now, later = [], []
        possible, allowed = [], []
        for b, (k, t) in enumerate(picks):
            trajectory = self.trajectories[k]
            end = min(t + c.n_step, len(trajectory))
            powers = c.gamma ** np.arange(end - t)
            reward[b] = powers @ (trajectory.terms[t:end] @ weights[b])
            if end < len(trajectory) or trajectory.ending != "crashed":
                discount[b] = c.gamma ** (end - t)
            now.append((trajectory, int(t)))
            later.append((trajectory, int(end)))
            possible.append(~trajectory.unsafe[t])
            safe = ~trajectory.unsafe[end]
            allowed.append(safe if safe.any() else np.ones_like(safe))
        return Batch(
            states(now, phi, device),
            states(later, phi, device),
            np.array([tr.action[t] for tr, t in now], np.int64),
            reward,
            discount,
            np.stack(possible),
            np.stack(allowed),
            np.array([tr.vetoed[t] for tr, t in now], np.int64),
            wrong,
        )

    def _places(self) -> list[Ints]:
        if self._index is None:
            rows = [
                np.stack([np.full(len(t), k), np.arange(len(t))], 1) for k, t in enumerate(self.trajectories)
            ]
            every, rest = np.concatenate(rows), np.ones(self.size, np.bool_)
            wanted = self.config.correcting > 0.0
            rare = [
                (t.yielding, t.wrong[:, MetaAction.IDLE] & wanted, t.interacting) for t in self.trajectories
            ]
            self._index = []
            for kind in zip(*rare, strict=True):
                mine = np.concatenate(kind) & rest
                self._index.append(every[mine])
                rest &= ~mine
            self._index.append(every[rest])
        return self._index


def _draw(places: Ints, count: int, rng: np.random.Generator) -> Ints:
    """`count` of the places, with replacement: [count,2]."""
    if not count:
        return np.zeros((0, 2), np.int64)
    return places[rng.integers(len(places), size=count)]
