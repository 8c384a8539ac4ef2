"""Who learns when from what: DDQN from the replay while others drive, A2C from what they just drove.

Both hear the mentor, where their configuration wants it, before they learn anything by themselves.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np

from cosim.seeding import generator, subseed
from policy.training.a2c import A2cLearner
from policy.training.curriculum import VfnTraining, faded
from policy.training.ddqn import Learner, Losses
from policy.training.experience import Trajectory
from policy.training.replay import Replay
from policy.vfn import VfnConfig

Told = dict[str, float]  # `loss/...` and the like, for the log
AnyLearner = TypeVar("AnyLearner", Learner, A2cLearner)


class School(Protocol):
    """What the trainer asks in every iteration `k`, in this order but for `epsilon`."""

    @property
    def learner(self) -> Learner | A2cLearner: ...

    @property
    def replay(self) -> Replay: ...

    def epsilon(self, k: int) -> float:
        """Share of random actions."""

    def guided(self, k: int) -> float:
        """Share of the episodes that the mentor drives."""

    def meanwhile(self, k: int) -> Told:
        """Learn what does not wait for this iteration's drives."""

    @property
    def keeps(self) -> bool:
        """Whether these drives join the replay."""

    def afterwards(self, k: int, drives: Sequence[Trajectory], kept: bool) -> Told:
        """Learn from these drives, which are in the replay if they were `kept`."""


class _Schooling(Generic[AnyLearner]):
    """What both have: a learner, its replay, and a mentor who is heard first where that is wanted."""

    def __init__(self, config: VfnTraining, vfn: VfnConfig, learner: AnyLearner, device: str) -> None:
        self.config, self.device = config, device
        self.learner: AnyLearner = learner
        self.kinematic = vfn.kinematic
        self.replay = Replay(config.replay)

    def epsilon(self, k: int) -> float:
        """Share of random actions."""
        return faded(self.config, self.config.epsilon, k)

    @property
    def _short(self) -> bool:
        """Whether the replay holds less than is wanted before anything is learned."""
        c = self.config
        return self.replay.size < (max(c.prefill, c.warm_up_after) if self.learner.listens else c.prefill)

    def _random(self, k: int) -> np.random.Generator:
        """Of what is drawn from the replay in iteration `k`."""
        return generator(self.config.seed, "replay", str(k))

    def _warm_up(self, rng: np.random.Generator) -> None:
        """Steps towards the mentor alone, on what the replay holds; with maps for who sees nothing else."""
        for _ in range(self.config.warm_up if self.learner.listens else 0):
            self.learner.imitate(self.replay.advised(rng, not self.kinematic, self.device))


class OffPolicy(_Schooling[Learner]):
    """P, algorithm 4: fill the replay by chance, hear the mentor, then so many updates an iteration."""

    keeps = True

    def __init__(self, config: VfnTraining, vfn: VfnConfig, device: str) -> None:
        super().__init__(config, vfn, Learner(vfn, config.ddqn, _start(config), device), device)

    def epsilon(self, k: int) -> float:
        """Share of random actions: all, while the replay is filled."""
        return 1.0 if self._short else super().epsilon(k)

    def guided(self, k: int) -> float:
        """Share of the episodes that the mentor drives."""
        return faded(self.config, self.config.guided, k)

    def meanwhile(self, k: int) -> Told:
        """This iteration's updates, on what the replay holds."""
        if self._short:
            return {}
        learner, rng = self.learner, self._random(k)
        if not learner.updates:
            self._warm_up(rng)
            learner.follow()
        losses, agrees = [], []
        for _ in range(self.config.updates):
            losses.append(learner.update(self.replay.sample(rng, self.device)))
            if learner.listens and self.kinematic:  # else an update hears him at the same price
                agrees.append(learner.imitate(self.replay.advised(rng, False, self.device)))
        means = _named(Losses._fields, np.array(losses).mean(0))
        return means | ({"agrees": float(np.mean(agrees))} if agrees else {})

    def afterwards(self, k: int, drives: Sequence[Trajectory], kept: bool) -> Told:
        """Nothing: they are learned from later."""
        return {}


class OnPolicy(_Schooling[A2cLearner]):
    """T's A2C: each drive is learned from once. With a mentor, his drives are kept until he was heard."""

    def __init__(self, config: VfnTraining, vfn: VfnConfig, device: str) -> None:
        super().__init__(config, vfn, A2cLearner(vfn, config.a2c, _start(config), device), device)

    def guided(self, k: int) -> float:
        """Share of the episodes that the mentor drives."""
        return 1.0 if self.keeps else 0.0

    def meanwhile(self, k: int) -> Told:
        """Nothing: it waits for the drives."""
        return {}

    @property
    def keeps(self) -> bool:
        """Whether the mentor has not shown enough yet; without him the replay stays empty."""
        return self.learner.listens and self._short

    def afterwards(self, k: int, drives: Sequence[Trajectory], kept: bool) -> Told:
        """A pass over its own drives; of the mentor's only the last, when the steps towards him are made."""
        if not kept:
            learned = self.learner.learn(drives, generator(self.config.seed, "order", str(k)))
            return {} if learned is None else _named(learned._fields, learned)
        if not self.keeps:
            self._warm_up(self._random(k))
        return {}


def school(config: VfnTraining, vfn: VfnConfig, device: str) -> School:
    """The one of `config.learning`."""
    return (OnPolicy if config.learning == "a2c" else OffPolicy)(config, vfn, device)


# ---- inside ----


def _start(config: VfnTraining) -> int:
    """The seed of the first weights."""
    return subseed(config.seed, "network") % 2**31


def _named(names: Sequence[str], values: Iterable[float]) -> Told:
    return {f"loss/{name}": float(v) for name, v in zip(names, values, strict=True)}
