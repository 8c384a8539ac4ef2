"""The loop of every supervised training: updates, logs, checkpoints, and going on after a kill.

A run is a folder: `state.safetensors` (weights, optimiser, counters and the log so far, replaced as a whole,
so that a kill leaves either the old state or the new one), `log.csv` and TensorBoard's event files. Batches
and learning rates follow from (seed, update), never from a generator that would have to be remembered: a run
that goes on after `kill -9` sees the very batches that the uninterrupted one sees.
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from cosim.errors import BadInput
from cosim.files import whole
from policy.training.log import tensorboard

Progress = Callable[[float, float], None]  # updates so far, of updates in all
Line = dict[str, float]


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """How long and how often."""

    updates: int = 8000
    log_every: int = 100  # updates a line of the log averages over
    validate_every: int = 500  # updates
    save_every: float = 30.0  # s between checkpoints: what a kill may cost


class Task(Protocol):
    """What is trained."""

    def update(self, number: int) -> Line:
        """Update number `number`, from 0; its losses by name."""

    def validate(self) -> Line:
        """Losses on the validation episodes."""

    def tensors(self) -> dict[str, torch.Tensor]:
        """Everything that the next update depends on, copied to the host."""

    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Back to a state."""


def train(
    task: Task,
    config: LoopConfig,
    folder: Path,
    *,
    layout: Mapping[str, Any],
    resume: bool = False,
    progress: Progress | None = None,
) -> list[Line]:
    """Train to the end; the whole log. `layout`: what the run is; a resumed one must be the same.

    Raises BadInput when the folder holds a run already (and `resume` is not given), or another one.
    """
    state_file = folder / "state.safetensors"
    said = json.loads(json.dumps(layout))
    log: list[Line] = []
    sums: Line = {}  # since the last line of the log
    done = 0
    if state_file.is_file():
        if not resume:
            raise BadInput("holds a training run already: --resume goes on", field="--out", value=str(folder))
        about, tensors = _read(state_file)
        if about["layout"] != said:
            names = said.keys() | about["layout"].keys()
            differs = sorted(k for k in names if said.get(k) != about["layout"].get(k))
            raise BadInput(
                f"the run in this folder is another one ({', '.join(differs)} differ)", file=folder
            )
        task.restore(tensors)
        done, log, sums = about["done"], about["log"], about["sums"]
    folder.mkdir(parents=True, exist_ok=True)
    writer = tensorboard(folder, done)
    saved = time.monotonic()
    try:
        while done < config.updates:
            for name, value in task.update(done).items():
                sums[name] = sums.get(name, 0.0) + value
            done += 1
            last = done == config.updates
            line: Line = {}
            if done % config.log_every == 0 or last:
                count = done % config.log_every or config.log_every
                line = {f"train_{name}": value / count for name, value in sums.items()}
                sums = {}
            if done % config.validate_every == 0 or last:
                line |= {f"validation_{name}": value for name, value in task.validate().items()}
            if line:
                log.append({"update": float(done), **line})
                for name, value in line.items():
                    writer.add_scalar(name.replace("_", "/", 1), value, done)
            if last or time.monotonic() - saved > config.save_every:
                about = {"layout": said, "done": done, "log": log, "sums": sums}
                _write(state_file, about, task.tensors())
                write_log(folder / "log.csv", log)
                writer.flush()
                saved = time.monotonic()
            if progress is not None:
                progress(done, config.updates)
    finally:
        writer.close()
    return log


def one_cycle(number: int, updates: int, rate: float) -> float:
    """Learning rate of an update: up to `rate` over the first three tenths, then down to nothing (cosine)."""
    warm = 0.3 * updates
    if number < warm:
        return rate * (0.04 + 0.96 * 0.5 * (1.0 - math.cos(math.pi * number / warm)))
    return rate * 0.5 * (1.0 + math.cos(math.pi * (number - warm) / (updates - warm)))


def write_log(path: Path, log: Sequence[Line]) -> None:
    """The log as CSV: a column per loss, empty where it was not taken."""
    names = list(dict.fromkeys(name for line in log for name in line))
    with whole(path) as draft, draft.open("w", newline="") as file:
        rows = csv.DictWriter(file, names, restval="")
        rows.writeheader()
        rows.writerows({k: f"{v:.6g}" for k, v in line.items()} for line in log)


def _write(path: Path, about: Mapping[str, Any], tensors: dict[str, torch.Tensor]) -> None:
    with whole(path) as draft:
        save_file(tensors, draft, metadata={"about": json.dumps(about)})


def _read(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            about = json.loads(file.metadata()["about"])
            return about, {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"not the state of a training run: {error}", file=path) from None
