"""The schedule of training episodes: lessons, seeds, exploration and weights, all drawn from one seed."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import NamedTuple

import numpy as np

from cosim.errors import BadInput, in_range
from cosim.seeding import TRAINING_SEEDS, TUNING_SEEDS, subseed, uniform
from cosim.types import Preset
from policy.training.a2c import A2cConfig
from policy.training.ddqn import DdqnConfig
from policy.training.experience import Trajectory
from policy.training.replay_buffer import ReplayConfig

MAX_PREFILL_SHARE = 0.9  # of the capacity: whole trajectories leave, so the buffer never fills up


@dataclass(frozen=True, slots=True)
class Lesson:
    """One kind of episode and its sampling weight."""

    scenario: str
    demand: str = "contested"
    behavior: str | None = None  # None: the demand's default
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class OnPolicy:
    """Additional options of A2C. T gives none of these."""

    keep: int = 1  # decisions that a drawn action is repeated: a gap takes longer than one of 0.4 s
    n_step: int = 8  # decisions of a return; the papers: 1
    passes: int = 1  # over an iteration's trajectories; 1 is A2C
    entropy: float = 0.01  # weight, against premature convergence


@dataclass(frozen=True, slots=True)
class VfnTraining:
    """One training run. Defaults: P's Table I where given, else suited to two CPU cores."""

    lessons: tuple[Lesson, ...] = (Lesson("merge"),)
    iterations: int = 400
    episodes: int = 2  # an iteration
    updates: int = 40  # an iteration: one every five joint decisions; 4 to 8 work
    prefill: int = 2_000  # decisions recorded with epsilon 1 before the first update (Alg. 4)
    epsilon: tuple[float, float] = (1.0, 0.05)  # P, Table I: linear
    epsilon_iterations: int = 200
    disseminate: int = 5  # iterations between copies of the learner's weights to the frozen AVs
    svo: tuple[float, ...] = (45.0, 60.0)  # deg, drawn per episode; (0,) trains an egoist
    seed: int = 0  # of the whole run
    validate_every: int = 20  # iterations; the last one is validated too
    validation: int = 4  # greedy episodes of every lesson, on validation seeds
    save_every: int = 5  # iterations
    errors: str = ""  # of the human drivers: a level or a user's file; "": none
    preset: str = Preset.UNGUARDED  # the car's own behaviour (docs/reference/presets.md)
    encoder: str = ""  # weights of `cosim train encoder`, for extractor `frames`: encoder, or a file
    learning_rate: float = 5e-4  # P, Table I
    gamma: float = 0.97  # a decision of 0.4 s; P: 0.95
    batch: int = 64  # P, Table I
    # DDQN
    n_step: int = 8  # decisions of a return; P: 1
    target_every: int = 300  # P, Table I
    refused: float = 1.0  # weight of the loss that values refused actions like a crash (P, algorithm 4)
    capacity: int = 30_000  # decisions in the replay buffer; P's 8,000 are 20 episodes of 4 learners
    interaction: float = 0.25  # share of a batch near a mission vehicle, or vetoed (P, algorithm 4)
    relabel: float = 0.5  # share of a batch relabelled with another SVO
    a2c: OnPolicy = field(default_factory=OnPolicy)

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range, or a prefill that the replay buffer cannot hold."""
        in_range(
            self,
            positive="iterations episodes updates epsilon_iterations disseminate validate_every save_every",
            not_negative="prefill validation",
        )
        _ = self.replay_config, self.ddqn_config, self.a2c_config  # each validates its numbers
        if self.prefill > MAX_PREFILL_SHARE * self.capacity:
            problem = f"nothing is learned before {self.prefill} decisions are kept"
            raise BadInput(problem, field="training.capacity", value=self.capacity)

    @property
    def replay_config(self) -> ReplayConfig:
        """The replay buffer's configuration."""
        kept = self.capacity, self.batch, self.n_step, self.gamma, self.interaction, self.relabel
        return ReplayConfig(*kept)

    @property
    def ddqn_config(self) -> DdqnConfig:
        """The DDQN learner's configuration."""
        rate, every, refused = self.learning_rate, self.target_every, self.refused
        return DdqnConfig(learning_rate=rate, target_every=every, refused=refused)

    @property
    def a2c_config(self) -> A2cConfig:
        """The A2C learner's configuration."""
        own = asdict(self.a2c)
        rate, gamma, batch = self.learning_rate, self.gamma, self.batch
        return A2cConfig(learning_rate=rate, gamma=gamma, batch=batch, normalize=True, **own)


class Drive(NamedTuple):
    """One episode to be driven; these fields determine its outcome."""

    lesson: Lesson
    seed: int
    svo: float  # rad
    epsilon: float
    weights: str  # file of the learning AVs' network, "" for untrained
    frozen: str  # file of the other AVs' network
    record: bool  # False: validation, greedy and without recording
    errors: str = ""  # of the human drivers
    preset: str = Preset.UNGUARDED
    keep: int = 0  # decisions that an action drawn from the preferences is repeated; 0: epsilon-greedy


class DriveResult(NamedTuple):
    """The result of one driven episode."""

    trajectories: list[Trajectory]
    figures: dict[str, float | None]  # crashed, mission_success, dt_..., reward (a decision and AV), steps


def drives(c: VfnTraining, k: int, weights: str, frozen: str, epsilon: float, keep: int = 0) -> list[Drive]:
    """The episodes of iteration `k`; `keep`: see `Drive`."""
    drawn = []
    for j in range(c.episodes):
        draws = [uniform(c.seed, name, str(k), str(j)) for name in ("lesson", "svo")]
        drawn.append(
            Drive(
                _drawn(c.lessons, draws[0]),
                (k * c.episodes + j + subseed(c.seed, "episodes")) % len(TRAINING_SEEDS),
                math.radians(c.svo[int(draws[1] * len(c.svo))]),
                epsilon,
                weights,
                frozen,
                record=True,
                errors=c.errors,
                preset=c.preset,
                keep=keep,
            )
        )
    return drawn


def is_validated(c: VfnTraining, k: int) -> bool:
    """Whether the weights that iteration `k` begins with are validated."""
    return (k % c.validate_every == 0 and k > 0) or k + 1 == c.iterations


def validation(c: VfnTraining, weights: str) -> list[Drive]:
    """Every lesson in turn, greedy, on validation seeds."""
    svo = math.radians(c.svo[len(c.svo) // 2])
    return [
        Drive(
            lesson,
            TUNING_SEEDS[j],
            svo,
            0.0,
            weights,
            weights,
            record=False,
            errors=c.errors,
            preset=c.preset,
        )
        for lesson in c.lessons
        for j in range(c.validation)
    ]


def exploration(c: VfnTraining, k: int) -> float:
    """Epsilon of iteration `k`: linear over `epsilon_iterations`, then the last."""
    first, last = c.epsilon
    return first + (last - first) * min(k / c.epsilon_iterations, 1.0)


def _drawn(lessons: Sequence[Lesson], at: float) -> Lesson:
    """The lesson at `at` (0 to 1) of the weights laid end to end."""
    edges = np.cumsum([lesson.weight for lesson in lessons])
    return lessons[int(np.searchsorted(edges / edges[-1], at, side="right").clip(0, len(lessons) - 1))]
