"""Training of the value network (P, algorithm 4; T's A2C): episodes in actors, updates here, in lock step.

DDQN: iteration k updates the network on the replay buffer while the actors drive its episodes with the
weights from the start of iteration k; then the new trajectories join the replay buffer. A2C waits for its
latest trajectories and learns from them only. Every number therefore depends on the configuration and the
seed alone, not on the speed of processes, and a killed run resumes exactly.
"""

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from safetensors.torch import load_file, save_file

from cosim.errors import BadInput
from cosim.files import read_json, whole
from cosim.seeding import TUNING_SEEDS
from policy import checkpoint
from policy.networks.vfn import VFN, VfnConfig
from policy.training import curriculum, experience
from policy.training.curriculum import Drive, DriveResult, VfnTraining
from policy.training.trainers import make_trainer

EXTENDABLE_FIELD = "iterations"  # the only field that may change when a run is resumed


class Actors(Protocol):
    """The executor of episodes (cosim.learning.rollouts)."""

    def submit(self, drive: Drive) -> Future[DriveResult]:
        """Queue the episode."""


class TrainingRun:
    """A training run in `folder`, which holds state, weights (`last` and `best`) and `log.jsonl`.

    Args:
        config: the schedule.
        vfn: layout of the network.
        actors: executor of episodes.
        folder: output folder; created if missing.
        device: of torch.
        log: TensorBoard's writer.
        about: additional content of the weights' cards.
    """

    def __init__(
        self,
        config: VfnTraining,
        vfn: VfnConfig,
        actors: Actors,
        folder: Path,
        *,
        device: str = "cpu",
        log: Any = None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.config, self.vfn, self.folder = config, vfn, folder
        self._actors, self._log, self._about, self._device = actors, log, dict(about or {}), device
        self.trainer = make_trainer(config, vfn, device)
        self._files: list[tuple[str, int]] = []  # replay buffer's files, oldest first, with trajectory counts
        self._gone = 0  # trajectories of the oldest file that have left the replay buffer
        self.iteration, self.best = 0, -math.inf
        for name in ("replay", "weights"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    # ---- the loop ----

    def run(self, progress: Callable[[float, float], None] | None = None) -> None:
        """Train to the last iteration, from the state of `resume`; without it from the start."""
        c, trainer = self.config, self.trainer
        if not self.iteration:  # remove files of a run killed before its first checkpoint
            for path in (*self.folder.glob("weights/*"), *self.folder.glob("replay/*")):
                path.unlink()
            (self.folder / "log.jsonl").unlink(missing_ok=True)
        while self.iteration < c.iterations:
            began = time.perf_counter()
            k = self.iteration
            weights, frozen = self._weights(k), self._weights(k - k % c.disseminate)
            epsilon = trainer.epsilon(k)
            drives = curriculum.drives(c, k, weights, frozen, epsilon, trainer.keep)
            driving = [self._actors.submit(drive) for drive in drives]
            judged = curriculum.validation(c, weights) if curriculum.is_validated(c, k) else []
            judging = [self._actors.submit(drive) for drive in judged]
            losses = trainer.learn_meanwhile(k)
            drove = [f.result() for f in driving]
            if trainer.stores:
                self._keep(k, drove)
            losses |= trainer.learn_afterwards(k, [t for one in drove for t in one.trajectories])
            record = {
                "iteration": k,
                "updates": trainer.learner.updates,
                "replay": trainer.replay.size,
                "epsilon": trainer.epsilon(k),
                **losses,
                **_means("train", [d.figures for d in drove]),
            }
            if judging:
                measured, file = {"iteration": k}, Path(self._weights(k))
                record |= self._judge([f.result().figures for f in judging], file, measured)
            record["iteration_s"] = time.perf_counter() - began
            self._write(record)
            self.iteration += 1
            if self.iteration % c.save_every == 0 or self.iteration == c.iterations:
                self.save()
            if progress is not None:
                progress(self.iteration, c.iterations)

    def _keep(self, k: int, drove: Sequence[DriveResult]) -> None:
        """Add to the replay buffer; files without remaining trajectories go at the next checkpoint."""
        for j, one in enumerate(drove):
            name = f"{k:06d}-{j:02d}.npz"
            experience.save(self.folder / "replay" / name, one.trajectories)
            self._files.append((name, len(one.trajectories)))
            self._gone += self.trainer.replay.add(one.trajectories)
            while self._files and self._gone >= self._files[0][1]:
                self._gone -= self._files.pop(0)[1]

    def _judge(
        self, figures: list[dict[str, float | None]], source: Path, measured: dict[str, Any]
    ) -> dict[str, Any]:
        """Validate the weights in `source`; the best weights are kept with their measured result."""
        means, count = _means("valid", figures), self.config.validation
        for at, lesson in enumerate(self.config.lessons):
            name = f"valid/{Path(lesson.scenario).name}-{lesson.demand}"
            means |= _means(name, figures[at * count : (at + 1) * count])
        if means["valid/reward"] > self.best:
            self.best = means["valid/reward"]
            seeds = [TUNING_SEEDS.start, self.config.validation]
            measured = {**measured, "validation": means, "tuning_seeds": seeds}
            networks, configs = {"vfn": VFN(self.vfn)}, {"vfn": self.vfn}
            card = checkpoint.load(source, networks, configs)
            checkpoint.save(self.folder / "best.safetensors", networks, configs, measured, card["data"])
        return means

    # ---- files ----

    def _weights(self, k: int) -> str:
        """The file of the weights at the start of iteration `k`."""
        path = self.folder / "weights" / f"{k:06d}.safetensors"
        if not path.is_file():
            if k != self.iteration:
                raise BadInput("weights of an earlier iteration are missing", file=path)
            about = {**self._about, "training": asdict(self.config)}
            network = self.trainer.learner.online
            checkpoint.save(path, {"vfn": network}, {"vfn": self.vfn}, {"iteration": k}, about)
        return str(path)

    def save(self) -> None:
        """Write a checkpoint for `resume` atomically."""
        name = f"state-{self.iteration:06d}.safetensors"
        state = {
            "iteration": self.iteration,
            "updates": self.trainer.learner.updates,
            "best": None if math.isinf(self.best) else self.best,
            "files": self._files,
            "gone": self._gone,
            "config": asdict(self.config),
            "vfn": asdict(self.vfn),
            "about": self._about,
            "tensors": name,
        }
        with whole(self.folder / name) as draft:
            save_file(self.trainer.learner.tensors(), draft)
        with whole(self.folder / "state.json") as draft:
            draft.write_text(json.dumps(state, indent=1))
        self._weights(self.iteration)
        # remove files that no checkpoint references
        kept = {name, *(file for file, _ in self._files)}
        files = [*(self.folder / "replay").glob("*.npz"), *self.folder.glob("state-*.safetensors")]
        oldest = self.iteration - self.iteration % self.config.disseminate
        old = [path for path in (self.folder / "weights").glob("*") if int(path.stem) < oldest]
        for path in [path for path in files if path.name not in kept] + old:
            path.unlink()

    def resume(self) -> bool:
        """Continue from the last checkpoint; False without a checkpoint.

        Raises BadInput when the folder was trained with another configuration.
        """
        file = self.folder / "state.json"
        if not file.is_file():
            return False
        state = read_json(file)
        differs = [
            name
            for part, own in (("config", self.config), ("vfn", self.vfn), ("about", self._about))
            for name in _differing(state[part], checkpoint.plain(own))
            if name != EXTENDABLE_FIELD
        ]
        if differs:
            raise BadInput("was trained with another configuration", file=file, field=", ".join(differs))
        self.iteration, self._gone = state["iteration"], state["gone"]
        self.best = -math.inf if state["best"] is None else state["best"]
        learner = self.trainer.learner
        learner.restore(load_file(self.folder / state["tensors"]))
        learner.updates = state["updates"]
        self._files = [(name, count) for name, count in state["files"]]
        for number, (name, _) in enumerate(self._files):
            trajectories = experience.load(self.folder / "replay" / name)
            self.trainer.replay.add(trajectories[self._gone if number == 0 else 0 :])
        for path in (self.folder / "weights").glob("*"):  # later weights will be learned again
            if int(path.stem) > self.iteration:
                path.unlink()
        log = self.folder / "log.jsonl"
        if log.is_file():  # lines after the checkpoint will be written again
            lines = [x for x in log.read_text().splitlines() if json.loads(x)["iteration"] < self.iteration]
            log.write_text("".join(f"{x}\n" for x in lines))
        return True

    def _write(self, record: Mapping[str, Any]) -> None:
        with (self.folder / "log.jsonl").open("a") as file:
            file.write(json.dumps(record) + "\n")
        if self._log is not None:
            for name, value in record.items():
                if isinstance(value, int | float) and math.isfinite(value):
                    self._log.add_scalar(name, value, record["iteration"])


def _differing(theirs: Mapping[str, Any], mine: Mapping[str, Any], where: str = "") -> list[str]:
    """Names of fields that differ or are missing on one side, such as `safety.dt`."""
    found = []
    for name in theirs.keys() | mine.keys():
        old, new = theirs.get(name, ...), mine.get(name, ...)
        if isinstance(old, dict) and isinstance(new, dict):
            found += _differing(old, new, f"{where}{name}.")
        elif old != new:
            found.append(f"{where}{name}")
    return sorted(found)


def _means(prefix: str, figures: Sequence[Mapping[str, float | None]]) -> dict[str, float]:
    """Mean of every figure over the episodes with a value."""
    out = {}
    for name in figures[0] if figures else ():
        known = [float(v) for f in figures if (v := f[name]) is not None]
        if known:
            out[f"{prefix}/{name}"] = float(np.mean(known))
    return out
