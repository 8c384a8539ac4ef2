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
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from safetensors.torch import load_file, save_file

from cosim.errors import BadInput
from cosim.seeding import generator, subseed, uniform
from policy import checkpoint
from policy.training import experience
from policy.training.a2c import A2cConfig, A2cLearner
from policy.training.ddqn import DdqnConfig, Learner, Losses
from policy.training.experience import Trajectory
from policy.training.replay import Replay, ReplayConfig
from policy.vfn import VFN, VfnConfig

TRAINING_SEEDS = 100_000  # 0 to 99,999 are for training, the next as many for validation (contract.md)


@dataclass(frozen=True, slots=True)
class Lesson:
    """One kind of episode and how often it is driven."""

    scenario: str
    demand: str = "contested"
    behavior: str | None = None  # None: the demand's default
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class VfnTraining:
    """One training run. Defaults: what trains on two CPU cores (docs/training.md)."""

    lessons: tuple[Lesson, ...] = (Lesson("merge"),)
    iterations: int = 400
    episodes: int = 2  # an iteration
    updates: int = 40  # an iteration: one every five joint decisions (compute.md: 4 to 8)
    prefill: int = 2_000  # decisions recorded before the first update (Alg. 4), with epsilon 1
    warm_up: int = 0  # steps towards the mentor alone before the first update,
    warm_up_after: int = 0  # from as many decisions at least
    epsilon: tuple[float, float] = (1.0, 0.05)  # P, Table I: linear
    epsilon_iterations: int = 200
    guided: tuple[float, float] = (0.5, 0.1)  # share of the episodes that the mentor drives, linear likewise
    disseminate: int = 5  # iterations between copies of the learner's weights to the frozen AVs
    svo: tuple[float, ...] = (45.0, 60.0)  # deg, drawn per episode; (0,) trains the egoistic twin
    seed: int = 0  # of everything
    validate_every: int = 20  # iterations; the last one is validated too
    validation: int = 4  # episodes of every lesson, greedy, on tuning seeds
    save_every: int = 5  # iterations
    learning: Literal["ddqn", "a2c"] = "ddqn"
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    ddqn: DdqnConfig = field(default_factory=DdqnConfig)
    a2c: A2cConfig = field(default_factory=A2cConfig)


class Drive(NamedTuple):
    """One episode to be driven; its outcome depends on nothing else."""

    lesson: Lesson
    seed: int
    svo: float  # rad
    epsilon: float
    weights: str  # file of the learning AVs' network, "" for untrained
    frozen: str  # file of the others'
    record: bool  # False: validation, greedy, nothing is recorded
    guided: bool = False  # by the mentor


class Drove(NamedTuple):
    """What came of it."""

    trajectories: list[Trajectory]
    figures: dict[str, float | None]  # crashed, mission_success, dt_..., reward (a decision and AV), steps


class Actors(Protocol):
    """Where episodes are driven (cosim.app.rollouts)."""

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
        self.config, self.vfn, self.folder, self.device = config, vfn, folder, device
        self._actors, self._log, self._about = actors, log, dict(about or {})
        start = subseed(config.seed, "network") % 2**31
        self.learner: Learner | A2cLearner
        if config.learning == "a2c":
            self.learner = A2cLearner(vfn, config.a2c, start, device)
        else:
            self.learner = Learner(vfn, config.ddqn, start, device)
        self.replay = Replay(config.replay)
        self._files: list[tuple[str, int]] = []  # replay files, oldest first, and their trajectories
        self._gone = 0  # trajectories of the oldest file that have left the replay already
        self.iteration = 0
        self.best = -math.inf
        (folder / "replay").mkdir(parents=True, exist_ok=True)
        (folder / "weights").mkdir(exist_ok=True)

    # ---- the loop ----

    def run(self, progress: Callable[[float, float], None] | None = None) -> None:
        """Train to the last iteration, from wherever `resume` left off."""
        c = self.config
        while self.iteration < c.iterations:
            began = time.perf_counter()
            k = self.iteration
            weights, frozen = self._weights(k), self._weights(k - k % c.disseminate)
            driving = [self._actors.submit(d) for d in self._drives(k, weights, frozen)]
            judged = []
            if (k % c.validate_every == 0 and k > 0) or k + 1 == c.iterations:
                judged = [self._actors.submit(d) for d in self._validation(weights)]
            fills, losses = self._fills(), self._learn(k)
            drove = [f.result() for f in driving]
            if isinstance(self.learner, A2cLearner) and not fills:
                fresh = [t for one in drove for t in one.trajectories]
                learned = self.learner.learn(fresh, generator(c.seed, "order", str(k)))
                losses = {} if learned is None else _named(learned._fields, learned)
            else:
                self._keep(k, drove)
                if isinstance(self.learner, A2cLearner) and not self._fills():
                    self._warm_up(generator(c.seed, "replay", str(k)))
            record = {
                "iteration": k,
                "updates": self.learner.updates,
                "replay": self.replay.size,
                "epsilon": self._epsilon(k),
                **losses,
                **_means("train", [d.figures for d in drove]),
            }
            if judged:
                record |= self._judge(k, [f.result().figures for f in judged])
            record["iteration_s"] = time.perf_counter() - began
            self._write(record)
            self.iteration += 1
            if self.iteration % c.save_every == 0 or self.iteration == c.iterations:
                self.save()
            if progress is not None:
                progress(self.iteration, c.iterations)

    def _learn(self, k: int) -> dict[str, float]:
        """The updates that do not wait for this iteration's drives."""
        c, learner = self.config, self.learner
        if isinstance(learner, A2cLearner) or self._fills():
            return {}
        rng = generator(c.seed, "replay", str(k))
        if not learner.updates:
            self._warm_up(rng)
            learner.follow()
        losses, agrees = [], []
        for _ in range(c.updates):
            losses.append(learner.update(self.replay.sample(rng, self.device)))
            if learner.listens and self.vfn.kinematic:  # else an update hears him at the same price
                agrees.append(learner.imitate(self.replay.advised(rng, False, self.device)))
        means = _named(Losses._fields, np.array(losses).mean(0))
        return means | ({"agrees": float(np.mean(agrees))} if agrees else {})

    def _warm_up(self, rng: np.random.Generator) -> None:
        """Steps towards the mentor alone, on what the replay holds; with maps for who sees nothing else."""
        for _ in range(self.config.warm_up if self.learner.listens else 0):
            self.learner.imitate(self.replay.advised(rng, not self.vfn.kinematic, self.device))

    def _drives(self, k: int, weights: str, frozen: str) -> list[Drive]:
        c = self.config
        drives = []
        for j in range(c.episodes):
            seed = (k * c.episodes + j + subseed(c.seed, "episodes")) % TRAINING_SEEDS
            drives.append(
                Drive(
                    _drawn(c.lessons, uniform(c.seed, "lesson", str(k), str(j))),
                    seed,
                    math.radians(c.svo[int(uniform(c.seed, "svo", str(k), str(j)) * len(c.svo))]),
                    self._epsilon(k),
                    weights,
                    frozen,
                    True,
                    self._guided(k, j),
                )
            )
        return drives

    def _validation(self, weights: str) -> list[Drive]:
        c = self.config
        svo = math.radians(c.svo[len(c.svo) // 2])
        return [
            Drive(lesson, TRAINING_SEEDS + j, svo, 0.0, weights, weights, False)
            for lesson in c.lessons
            for j in range(c.validation)
        ]

    def _epsilon(self, k: int) -> float:
        c = self.config
        return 1.0 if c.learning == "ddqn" and self._fills() else self._faded(c.epsilon, k)

    def _fills(self) -> bool:
        """Whether the replay is still being filled."""
        c, needed = self.config, 0  # decisions; A2C that hears no mentor keeps none
        if self.learner.listens:
            needed = max(c.prefill, c.warm_up_after)
        elif c.learning == "ddqn":
            needed = c.prefill
        return self.replay.size < needed

    def _guided(self, k: int, j: int) -> bool:
        c = self.config
        if c.learning == "a2c":  # it learns by its own drives alone, once it has heard what he does in his
            return self._fills()
        return uniform(c.seed, "guided", str(k), str(j)) < self._faded(c.guided, k)

    def _faded(self, ends: tuple[float, float], k: int) -> float:
        first, last = ends
        return first + (last - first) * min(k / self.config.epsilon_iterations, 1.0)

    def _keep(self, k: int, drove: Sequence[Drove]) -> None:
        for j, one in enumerate(drove):
            name = f"{k:06d}-{j:02d}.npz"
            experience.save(self.folder / "replay" / name, one.trajectories)
            self._files.append((name, len(one.trajectories)))
            self._drop(self.replay.add(one.trajectories))

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
                "tuning_seeds": [TRAINING_SEEDS, self.config.validation],
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
            checkpoint.save(path, {"vfn": self.learner.online}, {"vfn": self.vfn}, {"iteration": k}, about)
        return str(path)

    def save(self) -> None:
        """Checkpoint: everything that `resume` needs; whole or not at all."""
        state = {
            "iteration": self.iteration,
            "updates": self.learner.updates,
            "best": None if math.isinf(self.best) else self.best,
            "files": self._files,
            "gone": self._gone,
            "config": json.loads(json.dumps(asdict(self.config))),
        }
        name = f"state-{self.iteration:06d}.safetensors"
        draft = self.folder / ".state.part"
        save_file(self.learner.tensors(), draft)
        draft.replace(self.folder / name)
        draft.write_text(json.dumps({**state, "tensors": name}, indent=1))
        draft.replace(self.folder / "state.json")
        self._weights(self.iteration)
        self._sweep(name)

    def resume(self) -> bool:
        """Go on where the last checkpoint was; False when there is none.

        Raises BadInput when the folder was trained with another configuration.
        """
        file = self.folder / "state.json"
        if not file.is_file():
            return False
        state = json.loads(file.read_text())
        mine = json.loads(json.dumps(asdict(self.config)))
        differs = [name for name in mine if mine[name] != state["config"].get(name) and name != "iterations"]
        if differs:
            raise BadInput("was trained with another configuration", file=file, field=", ".join(differs))
        self.iteration, self._gone = state["iteration"], state["gone"]
        self.best = -math.inf if state["best"] is None else state["best"]
        self.learner.restore(load_file(self.folder / state["tensors"]), state["updates"])
        self._files = [(name, count) for name, count in state["files"]]
        skip = self._gone
        for name, _ in self._files:
            trajectories = experience.load(self.folder / "replay" / name)
            self.replay.add(trajectories[skip:])
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


def _named(names: Sequence[str], values: Iterable[float]) -> dict[str, float]:
    return {f"loss/{name}": float(v) for name, v in zip(names, values, strict=True)}


def _drawn(lessons: Sequence[Lesson], luck: float) -> Lesson:
    """The lesson at `luck` (0 to 1) of the weights laid end to end."""
    edges = np.cumsum([lesson.weight for lesson in lessons])
    return lessons[int(np.searchsorted(edges / edges[-1], luck, side="right").clip(0, len(lessons) - 1))]


def _means(prefix: str, figures: Sequence[Mapping[str, float | None]]) -> dict[str, float]:
    """Mean of every figure over the episodes that have it."""
    out = {}
    for name in figures[0] if figures else ():
        known = [float(v) for f in figures if (v := f[name]) is not None]
        if known:
            out[f"{prefix}/{name}"] = float(np.mean(known))
    return out
