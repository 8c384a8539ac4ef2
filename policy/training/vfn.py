"""Training of the value network (P, algorithm 4; T's A2C): drives elsewhere, updates here, in lock step.

DDQN: iteration k updates the network on what is in the replay while the actors drive its episodes with the
weights that iteration k began with; then the new trajectories join the replay. A2C learns from fresh drives
only: it waits for them. So every number depends on the configuration and the seed alone, not on which
process was faster, and a killed run goes on exactly.
"""

from __future__ import annotations

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
from policy.training import curriculum, experience
from policy.training.curriculum import Drive, Drove, VfnTraining
from policy.training.schools import school
from policy.vfn import VFN, VfnConfig


class Actors(Protocol):
    """Where episodes are driven (cosim.learning.rollouts)."""

    def submit(self, drive: Drive) -> Future[Drove]:
        """Drive it soon."""


class Log(Protocol):
    """Where scalars go (TensorBoard's writer fits)."""

    def add_scalar(self, tag: str, value: float, step: int) -> object:
        """One value."""


class Trainer:
    """`run` trains in `folder`: state, weights (`last` and `best`) and `log.jsonl` lie there."""

    def __init__(
        self,
        config: VfnTraining,
        vfn: VfnConfig,
        actors: Actors,
        folder: Path,
        *,
        device: str = "cpu",
        log: Log | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.config, self.vfn, self.folder = config, vfn, folder
        self._actors, self._log, self._about = actors, log, dict(about or {})
        self.school = school(config, vfn, device)
        self._files: list[tuple[str, int]] = []  # replay files, oldest first, and their trajectories
        self._gone = 0  # trajectories of the oldest file that have left the replay already
        self.iteration = 0
        self.best = -math.inf
        (folder / "replay").mkdir(parents=True, exist_ok=True)
        (folder / "weights").mkdir(exist_ok=True)

    # ---- the loop ----

    def run(self, progress: Callable[[float, float], None] | None = None) -> None:
        """Train to the last iteration, from wherever `resume` left off."""
        c, school = self.config, self.school
        while self.iteration < c.iterations:
            began = time.perf_counter()
            k = self.iteration
            weights, frozen = self._weights(k), self._weights(k - k % c.disseminate)
            driven = curriculum.drives(c, k, weights, frozen, school.epsilon(k), school.guided(k))
            driving = [self._actors.submit(drive) for drive in driven]
            judging = []
            if curriculum.judged(c, k):
                judging = [self._actors.submit(drive) for drive in curriculum.validation(c, weights)]
            losses = school.meanwhile(k)
            drove = [f.result() for f in driving]
            kept = school.keeps
            if kept:
                self._keep(k, drove)
            losses |= school.afterwards(k, [t for one in drove for t in one.trajectories], kept)
            record = {
                "iteration": k,
                "updates": school.learner.updates,
                "replay": school.replay.size,
                "epsilon": school.epsilon(k),
                **losses,
                **_means("train", [d.figures for d in drove]),
            }
            if judging:
                record |= self._judge(k, [f.result().figures for f in judging])
            record["iteration_s"] = time.perf_counter() - began
            self._write(record)
            self.iteration += 1
            if self.iteration % c.save_every == 0 or self.iteration == c.iterations:
                self.save()
            if progress is not None:
                progress(self.iteration, c.iterations)

    def _keep(self, k: int, drove: Sequence[Drove]) -> None:
        for j, one in enumerate(drove):
            name = f"{k:06d}-{j:02d}.npz"
            experience.save(self.folder / "replay" / name, one.trajectories)
            self._files.append((name, len(one.trajectories)))
            self._drop(self.school.replay.add(one.trajectories))

    def _drop(self, trajectories: int) -> None:
        """Forget files whose trajectories have all left the replay; deleted with the next checkpoint."""
        self._gone = self._gone + trajectories
        while self._files and self._gone >= self._files[0][1]:
            self._gone -= self._files.pop(0)[1]

    def _judge(self, k: int, figures: list[dict[str, float | None]]) -> dict[str, Any]:
        """Validation of the weights that iteration `k` began with; the best are kept."""
        means = _means("valid", figures)
        lessons = [lesson for lesson in self.config.lessons for _ in range(self.config.validation)]
        for lesson in self.config.lessons:
            own = [f for f, of in zip(figures, lessons, strict=True) if of == lesson]
            means |= _means(f"valid/{lesson.scenario}-{lesson.demand}", own)
        score = means["valid/reward"]
        if score > self.best:
            self.best = score
            source = Path(self._weights(k))
            measured = {
                "iteration": k,
                "validation": means,
                "tuning_seeds": [TUNING_SEEDS.start, self.config.validation],
            }
            card = checkpoint.read_card(source)
            networks = {"vfn": VFN(self.vfn)}
            checkpoint.load(source, networks, {"vfn": self.vfn})
            checkpoint.save(
                self.folder / "best.safetensors", networks, {"vfn": self.vfn}, measured, card["data"]
            )
        return means

    # ---- files ----

    def _weights(self, k: int) -> str:
        """The file of the weights that iteration `k` began with."""
        path = self.folder / "weights" / f"{k:06d}.safetensors"
        if not path.is_file():
            if k != self.iteration:
                raise BadInput("weights of an earlier iteration are missing", file=path)
            about = {**self._about, "training": asdict(self.config)}
            checkpoint.save(
                path, {"vfn": self.school.learner.online}, {"vfn": self.vfn}, {"iteration": k}, about
            )
        return str(path)

    def save(self) -> None:
        """Checkpoint: everything that `resume` needs; whole or not at all."""
        state = {
            "iteration": self.iteration,
            "updates": self.school.learner.updates,
            "best": None if math.isinf(self.best) else self.best,
            "files": self._files,
            "gone": self._gone,
            "config": json.loads(json.dumps(asdict(self.config))),
        }
        name = f"state-{self.iteration:06d}.safetensors"
        with whole(self.folder / name) as draft:
            save_file(self.school.learner.tensors(), draft)
        with whole(self.folder / "state.json") as draft:
            draft.write_text(json.dumps({**state, "tensors": name}, indent=1))
        self._weights(self.iteration)
        self._sweep(name)

    def resume(self) -> bool:
        """Go on where the last checkpoint was; False when there is none.

        Raises BadInput when the folder was trained with another configuration.
        """
        file = self.folder / "state.json"
        if not file.is_file():
            return False
        state = read_json(file)
        mine = json.loads(json.dumps(asdict(self.config)))
        differs = [name for name in mine if mine[name] != state["config"].get(name) and name != "iterations"]
        if differs:
            raise BadInput("was trained with another configuration", file=file, field=", ".join(differs))
        self.iteration, self._gone = state["iteration"], state["gone"]
        self.best = -math.inf if state["best"] is None else state["best"]
        self.school.learner.restore(load_file(self.folder / state["tensors"]), state["updates"])
        self._files = [(name, count) for name, count in state["files"]]
        skip = self._gone
        for name, _ in self._files:
            trajectories = experience.load(self.folder / "replay" / name)
            self.school.replay.add(trajectories[skip:])
            skip = 0
        log = self.folder / "log.jsonl"
        if log.is_file():  # lines after the checkpoint will be written again
            lines = [x for x in log.read_text().splitlines() if json.loads(x)["iteration"] < self.iteration]
            log.write_text("".join(f"{x}\n" for x in lines))
        return True

    def _sweep(self, state: str) -> None:
        """Remove what no checkpoint needs any more."""
        kept = {name for name, _ in self._files}
        oldest = self.iteration - self.iteration % self.config.disseminate
        for path in (self.folder / "replay").glob("*.npz"):
            if path.name not in kept:
                path.unlink()
        for path in (self.folder / "weights").glob("*"):
            if int(path.stem) < oldest:
                path.unlink()
        for path in self.folder.glob("state-*.safetensors"):
            if path.name != state:
                path.unlink()

    def _write(self, record: Mapping[str, Any]) -> None:
        with (self.folder / "log.jsonl").open("a") as file:
            file.write(json.dumps(record) + "\n")
        if self._log is not None:
            for name, value in record.items():
                if isinstance(value, int | float) and math.isfinite(value):
                    self._log.add_scalar(name, value, record["iteration"])


def _means(prefix: str, figures: Sequence[Mapping[str, float | None]]) -> dict[str, float]:
    """Mean of every figure over the episodes that have it."""
    out = {}
    for name in figures[0] if figures else ():
        known = [float(v) for f in figures if (v := f[name]) is not None]
        if known:
            out[f"{prefix}/{name}"] = float(np.mean(known))
    return out
