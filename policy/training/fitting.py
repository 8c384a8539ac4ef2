"""Fits a small network to examples that lie in memory, on the loop of every supervised training."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from policy.training.loop import Line, LoopConfig, Progress, Task, train

Batch = Mapping[str, torch.Tensor]  # name -> [S,...], S the same for all
Loss = Callable[[Batch], torch.Tensor]
CHECKED = 8192  # validation examples a loss is taken on, about


@dataclass(frozen=True, slots=True)
class FitConfig:
    """One fit with Adam and a learning rate that falls along a cosine to 0."""

    steps: int = 6000
    batch: int = 1024
    learning_rate: float = 1e-2
    seed: int = 0


class FitTask(Task):
    """Training of one network by one loss; arguments as in `fit`."""

    def __init__(
        self, network: nn.Module, loss: Loss, config: FitConfig, examples: Batch, validation: Batch
    ) -> None:
        self._loss, self._config, self._examples = loss, config, examples
        stride = max(len(next(iter(validation.values()))) // CHECKED, 1)
        checked = {name: tensor[::stride] for name, tensor in validation.items()}
        adam = torch.optim.Adam(network.parameters(), config.learning_rate)
        super().__init__(network, adam, self._rate, [(checked, 1)])

    def _rate(self, number: int) -> float:
        c = self._config
        return 0.5 * c.learning_rate * (1.0 + math.cos(math.pi * number / c.steps))

    def batch(self, number: int) -> Batch:
        """See `Task.batch`."""
        rng = np.random.default_rng((self._config.seed, number))
        count = len(next(iter(self._examples.values())))
        rows = torch.from_numpy(rng.integers(0, count, self._config.batch))
        return {name: tensor[rows] for name, tensor in self._examples.items()}

    def losses(self, batch: Batch) -> dict[str, torch.Tensor]:
        """See `Task.losses`."""
        return {"loss": self._loss(batch)}


def fit(
    network: nn.Module,
    loss: Loss,
    config: FitConfig,
    examples: Batch,
    validation: Batch,
    *,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> list[Line]:
    """Fit `network` in place; returns the log of losses. A fit that left a state in `folder` goes on.

    Raises BadInput when `folder` holds another fit.
    """
    task = FitTask(network, loss, config, examples, validation)
    shapes = {name: list(value.shape) for name, value in network.state_dict().items()}
    layout = {"config": asdict(config), "shapes": shapes, "examples": len(next(iter(examples.values())))}
    times = LoopConfig(updates=config.steps)
    with tempfile.TemporaryDirectory(prefix="cosim-fit-") as scratch:
        where = folder or Path(scratch)
        return train(task, times, where, layout=layout, resume=True, progress=progress)
