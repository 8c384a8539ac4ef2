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

from policy.training.loop import Line, LoopConfig, Progress, train
from policy.training.networks import adam_tensors, restore_adam

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


class FitTask:
    """`policy.training.loop.Task` of one network and one loss."""

    def __init__(
        self, network: nn.Module, loss: Loss, config: FitConfig, examples: Batch, validation: Batch
    ) -> None:
        self._network, self._loss, self._config = network, loss, config
        self._examples = examples
        stride = max(len(next(iter(validation.values()))) // CHECKED, 1)
        self._validation = {name: tensor[::stride] for name, tensor in validation.items()}
        self._count = len(next(iter(examples.values())))
        self._optimizer = torch.optim.Adam(network.parameters(), config.learning_rate)

    def update(self, number: int) -> Line:
        """See `Task.update`."""
        c = self._config
        rng = np.random.default_rng((c.seed, number))  # of this step alone: going on changes nothing
        rows = torch.from_numpy(rng.integers(0, self._count, c.batch))
        value = self._loss({name: tensor[rows] for name, tensor in self._examples.items()})
        self._optimizer.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]
        for group in self._optimizer.param_groups:
            group["lr"] = 0.5 * c.learning_rate * (1.0 + math.cos(math.pi * number / c.steps))
        self._optimizer.step()
        return {"loss": float(value.detach())}

    def validate(self) -> Line:
        """See `Task.validate`."""
        with torch.no_grad():
            return {"loss": float(self._loss(self._validation))}

    def tensors(self) -> dict[str, torch.Tensor]:
        """See `Task.tensors`."""
        return adam_tensors({"network": self._network}, self._optimizer)

    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """See `Task.restore`."""
        restore_adam(tensors, {"network": self._network}, self._optimizer)


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
