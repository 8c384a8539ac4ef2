"""Networks made from a seed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

Made = TypeVar("Made")


def seeded(build: Callable[[], Made], seed: int) -> Made:
    """What `build` makes, weights drawn from `seed`; torch's generator is left as it was."""
    state = torch.random.get_rng_state()
    torch.manual_seed(seed)  # module initialisers know no generator
    made = build()
    torch.random.set_rng_state(state)
    return made
