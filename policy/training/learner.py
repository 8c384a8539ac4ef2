"""The common base of both learners: a value network and its optimiser."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from policy.networks.seeded import seeded
from policy.networks.vfn import VFN, VfnConfig
from policy.training.networks import Optimized

Metrics = dict[str, float]


class Learner(Optimized):
    """The network that is trained (`online`) and its optimiser.

    Args:
        vfn: layout of the network.
        config: optimisation; both kinds have `learning_rate` and `clip`.
        seed: of the first weights.
        device: of torch.
    """

    def __init__(self, vfn: VfnConfig, config: Any, seed: int, device: str = "cpu") -> None:
        self.config, self.device = config, device
        self.online: VFN = seeded(lambda: VFN(vfn), seed)
        self.online.to(device=device, memory_format=self.online.layout)  # type: ignore[call-overload]
        learning = [p for p in self.online.parameters() if p.requires_grad]  # an encoder is frozen
        adam = torch.optim.Adam(learning, lr=config.learning_rate)
        super().__init__({"online": self.online}, adam, config.clip)
        self.updates = 0


def mean_metrics(each: Sequence[Metrics]) -> Metrics:
    """Means of metrics with the same names."""
    means = np.array([list(one.values()) for one in each]).mean(0)
    return dict(zip(each[0], means.tolist(), strict=True))
