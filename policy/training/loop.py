"""The loop of every supervised training: updates, logs, checkpoints and resumption after a kill.

A run is a folder with `state.safetensors` (weights, optimiser, counters and the log so far), `log.csv` and
TensorBoard's event files. The state is replaced atomically, so a kill leaves either the old or the new one.
Batches and learning rates follow from (seed, update), not from a stateful generator: a run resumed after
`kill -9` sees the same batches as an uninterrupted run.
"""

import csv
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from cosim.errors import BadInput
from cosim.files import whole
from cosim.seeding import generator
from policy.training.networks import Optimized

Progress = Callable[[float, float], None]  # updates so far, total updates
Line = dict[str, float]
Example = TypeVar("Example")


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """Length of the training and intervals of its outputs."""

    updates: int = 8000
    log_every: int = 100  # updates a line of the log averages over
    validate_every: int = 500  # updates
    save_every: float = 30.0  # s between checkpoints

    @classmethod
    def of(cls, updates: int) -> "LoopConfig":
        """`updates` updates: 40 lines of the log, 8 validations."""
        return cls(updates, math.ceil(updates / 40), math.ceil(updates / 8))


class Task(Optimized):
    """Training of one network on examples; subclasses define batches and losses.

    Args:
        network: the trained network.
        optimizer: of its parameters.
        schedule: update number, from 0 -> learning rate.
        validation: batches as `losses` takes them, and the weight of each in the mean.
        clip: largest norm of the gradient; None: unlimited.
    """

    def __init__(
        self,
        network: nn.Module,
        optimizer: torch.optim.Optimizer,
        schedule: Callable[[int], float],
        validation: Sequence[tuple[Any, int]],
        clip: float | None = None,
    ) -> None:
        super().__init__({"network": network}, optimizer, clip)
        self._schedule, self._validation = schedule, validation

    def batch(self, number: int) -> Any:
        """The batch of update `number`; a function of `number` and the seed."""
        raise NotImplementedError

    def losses(self, batch: Any) -> dict[str, torch.Tensor]:
        """Scalars by name; `loss` is minimised."""
        raise NotImplementedError

    def update(self, number: int) -> Line:
        """Update number `number`, from 0; its losses by name."""
        found = self.losses(self.batch(number))
        self.step(found["loss"], self._schedule(number))
        return {name: float(value.detach()) for name, value in found.items()}

    def validate(self) -> Line:
        """Mean losses over the validation batches."""
        sums: Line = {}
        total = sum(weight for _, weight in self._validation)
        with torch.no_grad():
            for batch, weight in self._validation:
                for name, value in self.losses(batch).items():
                    sums[name] = sums.get(name, 0.0) + float(value) * weight / total
        return sums


def drawn(examples: Sequence[Example], count: int, seed: int, number: int) -> list[Example]:
    """`count` examples for update `number`, with replacement."""
    return [examples[k] for k in generator(seed, "batch", str(number)).integers(len(examples), size=count)]


def train(
    task: Task,
    config: LoopConfig,
    folder: Path,
    *,
    layout: Mapping[str, Any],
    resume: bool = False,
    progress: Progress | None = None,
) -> list[Line]:
    """Train to the end; returns the log. `layout` describes the run and must be equal on resumption.

    Raises BadInput when the folder holds a run already (without `resume`), or another run.
    """
    state_file = folder / "state.safetensors"
    wanted = json.loads(json.dumps(layout))
    log: list[Line] = []
    sums: Line = {}  # since the last line of the log
    done = 0
    if state_file.is_file():
        if not resume:
            raise BadInput("holds a training run already: --resume goes on", field="--out", value=str(folder))
        about, tensors = _read(state_file)
        names = wanted.keys() | about["layout"].keys()
        differs = sorted(k for k in names if wanted.get(k) != about["layout"].get(k))
        if differs:
            raise BadInput(
                f"the run in this folder is another one ({', '.join(differs)} differ)", file=folder
            )
        task.restore(tensors)
        done, log, sums = about["done"], about["log"], about["sums"]
    folder.mkdir(parents=True, exist_ok=True)
    saved = time.monotonic()
    with tensorboard(folder, done) as writer:
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
                about = {"layout": wanted, "done": done, "log": log, "sums": sums}
                with whole(state_file) as draft:
                    save_file(task.tensors(), draft, metadata={"about": json.dumps(about)})
                write_log(folder / "log.csv", log)
                writer.flush()
                saved = time.monotonic()
            if progress is not None:
                progress(done, config.updates)
    return log


def tensorboard(folder: Path, begin: int | None = None) -> Any:
    """A writer of scalars into `folder`/tensorboard; existing records from step `begin` on are superseded."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder / "tensorboard"), purge_step=begin)


def one_cycle(number: int, updates: int, rate: float) -> float:
    """Learning rate of an update: up to `rate` over the first three tenths, then down to 0 (cosine)."""
    warm = 0.3 * updates
    if number < warm:
        return rate * (0.04 + 0.96 * 0.5 * (1.0 - math.cos(math.pi * number / warm)))
    return rate * 0.5 * (1.0 + math.cos(math.pi * (number - warm) / (updates - warm)))


def write_log(path: Path, log: Sequence[Line]) -> None:
    """The log as CSV: a column per loss, empty where not measured."""
    names = list(dict.fromkeys(name for line in log for name in line))
    with whole(path) as draft, draft.open("w", newline="") as file:
        rows = csv.DictWriter(file, names, restval="")
        rows.writeheader()
        rows.writerows({k: f"{v:.6g}" for k, v in line.items()} for line in log)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            about = json.loads(file.metadata()["about"])
            return about, {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"not the state of a training run: {error}", file=path) from None
