"""A toy traffic model of known crash rate, with errors drawn and tilted like those of human drivers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cosim.scenario.tilt import Tilt
from cosim.scenario.tilt import log_ratio as of_trial

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
KINDS = ("inattention", "hard_braking", "stalled_car")
SECONDS = 60
LAPSE = 3  # s, duration of inattention
KM = np.array([0.025, 0.010])  # km per s in open and in dense traffic
TRANSITION = np.array([[0.9, 0.1], [0.2, 0.8]])  # probability per s, [from,to] open, dense


class Episodes(NamedTuple):
    """Several episodes, all arrays of the same shape."""

    crashes: Array  # 0 or 1: a crash ends an episode
    km: Array
    weights: Array


class Toy:
    """Traffic is open or dense by a Markov chain, with trials of errors every second.

    Inattention lasts for `LAPSE` s and rarely causes a crash, only in dense traffic. Hard braking happens in
    dense traffic and rarely causes a crash, unless the follower is inattentive. A stalled car is very rare
    and dangerous. `danger` multiplies the crash probabilities, which stands for another policy.
    """

    def __init__(self, rates: tuple[float, float, float] = (1e-4, 2e-4, 2e-6), danger: float = 1.0) -> None:
        self.rates, self.danger = rates, danger

    def eligible(self, dense: Ints, inattentive: Ints) -> list[Bools]:
        """Whether an error of each kind can begin."""
        return [inattentive == 0, dense == 1, np.ones(dense.shape, bool)]

    def crash(self, dense: Ints, inattentive: Ints, begun: list[Bools]) -> Array:
        """The probability of a crash in this second."""
        attention, braking, stalled = begun
        safe = 1.0 - self.danger * 0.02 * (dense * attention)
        safe *= 1.0 - self.danger * np.where(inattentive > 0, 0.6, 0.05) * braking
        return np.asarray(1.0 - safe * (1.0 - self.danger * 0.3 * stalled))

    def truth(self) -> float:
        """Exact crashes per km, from the distribution of the chain's states in every second."""
        states = [np.array(s) for s in np.indices((2, LAPSE + 1)).reshape(2, -1)]
        dense, inattentive = states
        size = len(dense)
        step, crash = np.zeros((size, size)), np.zeros(size)
        can = self.eligible(dense, inattentive)
        for outcome in np.ndindex(2, 2, 2):
            begun = [np.full(size, bool(b)) for b in outcome]
            chances = [
                np.where(e, p if b else 1.0 - p, 0.0 if b else 1.0)
                for e, p, b in zip(can, self.rates, outcome, strict=True)
            ]
            chance, crashes = np.prod(chances, 0), self.crash(dense, inattentive, begun)
            crash += chance * crashes
            after = np.where(begun[0], LAPSE, np.maximum(inattentive - 1, 0))
            for now in (0, 1):
                np.add.at(
                    step,
                    (np.arange(size), now * (LAPSE + 1) + after),
                    chance * (1.0 - crashes) * TRANSITION[dense, now],
                )
        here = np.zeros(size)
        here[0] = 1.0
        crashed = km = 0.0
        for _ in range(SECONDS):
            crashed += float(here @ crash)
            km += float(here @ KM[dense])
            here = here @ step
        return crashed / km

    def drive(self, shape: tuple[int, ...], tilt: Tilt, seed: int) -> Episodes:
        """Episodes drawn from the mixture of `tilt`; draws depend on the seed, not on `danger`."""
        rng = np.random.default_rng(seed)
        tilted = rng.random(shape) >= tilt.untilted
        log_ratio, crashes, km = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        live, dense, inattentive = np.ones(shape, bool), np.zeros(shape, int), np.zeros(shape, int)
        for _ in range(SECONDS):
            km += live * KM[dense]
            begun = []
            for kind, p, can in zip(KINDS, self.rates, self.eligible(dense, inattentive), strict=True):
                begins = rng.random(shape) < np.where(tilted, tilt.rate(kind, p), p)
                ratio = np.where(begins, *(of_trial(p, tilt.rate(kind, p), b) for b in (True, False)))
                log_ratio += np.where(live & can, ratio, 0.0)
                begun.append(begins & can)
            crash = live & (rng.random(shape) < self.crash(dense, inattentive, begun))
            crashes += crash
            live &= ~crash
            inattentive = np.where(begun[0], LAPSE, np.maximum(inattentive - 1, 0))
            dense = (rng.random(shape) < TRANSITION[dense, 1]).astype(int)
        return Episodes(crashes, km, np.vectorize(tilt.weight)(log_ratio))
