"""Networks made from a seed."""

from collections.abc import Callable
from typing import TypeVar

import torch

from cosim.seeding import subseed

Made = TypeVar("Made")


def seeded(build: Callable[[], Made], seed: int) -> Made:
    """The result of `build` with weights drawn from `seed`; torch's global generator is restored."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)  # module initialisers take no generator
        return build()


def first_weights(build: Callable[[], Made], seed: int) -> Made:
    """`seeded` for the network of a training run with the overall seed `seed`."""
    return seeded(build, subseed(seed, "network") % 2**31)
