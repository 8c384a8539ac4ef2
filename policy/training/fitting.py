"""Gradient descent on examples that fit into memory: seeded step by step, and resumable to the bit."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from policy.training.networks import adam_tensors, restore_adam

SAVE_EVERY = 200  # steps: at most so many are lost when it is killed

Batch = Mapping[str, torch.Tensor]
Loss = Callable[[Batch], torch.Tensor]
Progress = Callable[[float, float], None]


@dataclass(frozen=True, slots=True)
class FitConfig:
    """One fit with Adam and a learning rate that falls along a cosine to 0."""

    steps: int = 2000
    batch: int = 1024
    learning_rate: float = 1e-2
    seed: int = 0


def fit(
    network: nn.Module,
    examples: Batch,
    loss: Loss,
    config: FitConfig,
    *,
    state: Path | None = None,
    progress: Progress | None = None,
) -> float:
    """Fit `network` in place; `loss` takes a batch of `examples` (tensors with a common first length).

    `state`: where to keep what a later call with the same configuration, network and data needs to go on.
    Returns the mean loss of the last 100 steps.
    """
    count = len(next(iter(examples.values())))
    optimizer = torch.optim.Adam(network.parameters(), config.learning_rate)
    fingerprint = _fingerprint(network, count, config)
    first = 0 if state is None else _resume(state, network, optimizer, fingerprint)
    recent = [math.nan]
    for step in range(first, config.steps):
        rate = 0.5 * config.learning_rate * (1.0 + math.cos(math.pi * step / config.steps))
        for group in optimizer.param_groups:
            group["lr"] = rate
        rng = np.random.default_rng((config.seed, step))  # of this step alone: resuming changes nothing
        rows = torch.from_numpy(rng.integers(0, count, config.batch))
        value = loss({name: tensor[rows] for name, tensor in examples.items()})
        optimizer.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        recent = [*recent[-99:], float(value.detach())]
        if progress is not None:
            progress(step + 1, config.steps)
        if state is not None and ((step + 1) % SAVE_EVERY == 0 or step + 1 == config.steps):
            _save(state, network, optimizer, fingerprint, step + 1)
    return float(np.nanmean(recent)) if len(recent) > 1 else math.nan


def _fingerprint(network: nn.Module, count: int, config: FitConfig) -> str:
    shapes = {name: list(value.shape) for name, value in network.state_dict().items()}
    return hashlib.sha256(json.dumps([asdict(config), count, shapes]).encode()).hexdigest()


def _save(
    file: Path, network: nn.Module, optimizer: torch.optim.Optimizer, fingerprint: str, step: int
) -> None:
    tensors = adam_tensors({"network": network}, optimizer)
    draft = file.with_suffix(".part")
    save_file(tensors, draft, metadata={"fingerprint": fingerprint, "step": str(step)})
    draft.replace(file)


def _resume(file: Path, network: nn.Module, optimizer: torch.optim.Optimizer, fingerprint: str) -> int:
    """Steps already done; 0 when there is nothing that fits."""
    if not file.is_file():
        return 0
    try:
        with safe_open(file, framework="pt", device="cpu") as stored:
            about = stored.metadata() or {}
            if about.get("fingerprint") != fingerprint:
                return 0
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    except SafetensorError:
        return 0
    restore_adam(tensors, {"network": network}, optimizer)
    return int(about["step"])
