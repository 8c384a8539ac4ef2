"""Networks made from a seed."""

from collections.abc import Callable
from typing import TypeVar

import torch

from cosim.seeding import subseed

Made = TypeVar("Made")


def seeded(build: Callable[[], Made], seed: int) -> Made:
    """What `build` makes, weights drawn from `seed`; torch's generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)  # module initialisers know no generator
        return build()


def first_weights(build: Callable[[], Made], seed: int) -> Made:
    """`seeded` for the network of a training whose seed of everything is `seed`."""
    return seeded(build, subseed(seed, "network") % 2**31)
