"""The training loop of every supervised network: updates, logs, checkpoints, and going on after a kill.

A run is a folder: `state.pt` (networks, optimizers, counters; replaced as a whole, so that a kill leaves
either the old or the new one), `log.csv`, TensorBoard's event files and, at the end, the weights. Batches are
drawn from (seed, update), never from a generator that would have to be remembered: a run that goes on after
`kill -9` sees the very batches that the uninterrupted one sees.
"""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch.utils.tensorboard import SummaryWriter

from cosim.errors import BadInput

Progress = Callable[[float, float], None]  # updates so far, of updates in all


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """How long and how often."""

    updates: int = 8000
    log_every: int = 100  # updates between two lines of the log: averages over them
    validate_every: int = 500  # updates
    save_every: float = 30.0  # s between checkpoints: what a kill may cost


class Task(Protocol):
    """What is trained."""

    def update(self, number: int) -> dict[str, float]:
        """Update number `number` (from 0); returns losses by name."""

    def validate(self) -> dict[str, float]:
        """Losses on the validation episodes."""

    def state(self) -> dict[str, Any]:
        """Everything that the next update depends on: tensors, numbers, dicts and lists of them."""

    def restore(self, state: Mapping[str, Any]) -> None:
        """Back to a state."""


def train(
    task: Task,
    config: LoopConfig,
    folder: Path,
    *,
    layout: Mapping[str, Any],
    resume: bool = False,
    progress: Progress | None = None,
) -> list[dict[str, float]]:
    """Train to the end and return the whole log. `layout`: what the run is; a resumed one must be the same.

    Raises BadInput when the folder holds a run already (and `resume` is not given), or another one.
    """
    state_file = folder / "state.pt"
    log: list[dict[str, float]] = []
    done = 0
    said = json.loads(json.dumps(layout))
    if state_file.is_file():
        if not resume:
            raise BadInput(
                "holds a training run already (--resume continues it)", field="--out", value=str(folder)
            )
        # tensors and plain values only: nothing that could run code is read
        state = torch.load(state_file, map_location="cpu", weights_only=True)
        if state["layout"] != said:
            differs = sorted(
                k for k in said.keys() | state["layout"].keys() if said.get(k) != state["layout"].get(k)
            )
            raise BadInput(
                f"the run in this folder is another one (differs in {', '.join(differs)})", file=folder
            )
        task.restore(state["task"])
        done, log = int(state["done"]), list(state["log"])
    folder.mkdir(parents=True, exist_ok=True)
    writer = SummaryWriter(str(folder), purge_step=done)
    saved = time.monotonic()
    sums: dict[str, float] = {}
    since = done % config.log_every
    if since:  # the averages of an unfinished line
        sums = dict(state["sums"])
    try:
        while done < config.updates:
            for name, value in task.update(done).items():
                sums[name] = sums.get(name, 0.0) + value
            done += 1
            since += 1
            line: dict[str, float] = {}
            if done % config.log_every == 0 or done == config.updates:
                line = {f"train_{name}": value / since for name, value in sums.items()}
                sums, since = {}, 0
            if done % config.validate_every == 0 or done == config.updates:
                line |= {f"validation_{name}": value for name, value in task.validate().items()}
            if line:
                log.append({"update": float(done), **line})
                for name, value in line.items():
                    writer.add_scalar(name.replace("_", "/", 1), value, done)
            if progress is not None:
                progress(done, config.updates)
            if time.monotonic() - saved > config.save_every or done == config.updates:
                writer.flush()
                _save(
                    state_file, {"layout": said, "done": done, "log": log, "sums": sums, "task": task.state()}
                )
                _write_log(folder / "log.csv", log)
                saved = time.monotonic()
    finally:
        writer.close()
    return log


def _save(path: Path, state: Mapping[str, Any]) -> None:
    draft = path.with_suffix(".part")
    torch.save(dict(state), draft)
    draft.replace(path)


def _write_log(path: Path, log: list[dict[str, float]]) -> None:
    names = list(dict.fromkeys(name for line in log for name in line))
    draft = path.with_suffix(".part")
    with draft.open("w", newline="") as file:
        rows = csv.DictWriter(file, names, restval="")
        rows.writeheader()
        rows.writerows({k: f"{v:.6g}" for k, v in line.items()} for line in log)
    draft.replace(path)
