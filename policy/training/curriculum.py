"""The schedule of drives: lessons, seeds, exploration and who drives, all drawn from one seed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from cosim.errors import BadInput, in_range
from cosim.seeding import TRAINING_SEEDS, TUNING_SEEDS, subseed, uniform
from cosim.types import Preset
from policy.training.a2c import A2cConfig
from policy.training.ddqn import DdqnConfig
from policy.training.experience import Trajectory
from policy.training.replay_buffer import ReplayConfig

WAITS = 0.9  # of the replay buffer: whole drives leave it, so that it is never quite full


@dataclass(frozen=True, slots=True)
class Lesson:
    """One kind of episode and how often it is driven."""

    scenario: str
    demand: str = "contested"
    behavior: str | None = None  # None: the demand's default
    weight: float = 1.0
    preset: str = ""  # what the car does by itself; "": as in the others (`VfnTraining.preset`)


@dataclass(frozen=True, slots=True)
class VfnTraining:
    """One training run. Defaults: what trains on two CPU cores (docs/guides/training.md)."""

    lessons: tuple[Lesson, ...] = (Lesson("merge"),)
    iterations: int = 400
    episodes: int = 2  # an iteration
    updates: int = 40  # an iteration: one every five joint decisions; 4 to 8 do
    prefill: int = 2_000  # decisions recorded before the first update (Alg. 4), with epsilon 1
    warm_up: int = 0  # steps towards the demonstrations alone before the first update,
    warm_up_after: int = 0  # from as many decisions at least
    epsilon: tuple[float, float] = (1.0, 0.05)  # P, Table I: linear
    epsilon_iterations: int = 200
    guided: tuple[float, float] = (
        0.5,
        0.1,
    )  # share of demonstrated episodes, linear likewise
    disseminate: int = 5  # iterations between copies of the learner's weights to the frozen AVs
    svo: tuple[float, ...] = (45.0, 60.0)  # deg, drawn per episode; (0,) trains the egoistic twin
    seed: int = 0  # of everything
    validate_every: int = 20  # iterations; the last one is validated too
    validation: int = 4  # episodes of every lesson, greedy, on tuning seeds
    save_every: int = 5  # iterations
    learning: Literal["ddqn", "a2c"] = "ddqn"
    reward: str = ""  # a user's, FILE.py:NAME, or one of `cosim.rewards.REWARDS`; "": the file's section
    metrics: tuple[str, ...] = ()  # a user's, FILE.py:NAME: logged besides
    errors: str = ""  # of the human drivers: a level or a user's file; "": none
    erring: float = 1.0  # share of the drives in which they err
    preset: str = Preset.UNGUARDED  # what the car does by itself (docs/reference/presets.md, Presets)
    encoder: str = (
        ""  # weights of `cosim train encoder`, for a network of extractor `frames`: encoder, or a file
    )
    first: str = ""  # weights to begin with, a file; "": drawn from the seed
    code: tuple[str, ...] = ()  # their files and SHA-256
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    ddqn: DdqnConfig = field(default_factory=DdqnConfig)
    a2c: A2cConfig = field(default_factory=A2cConfig)

    def __post_init__(self) -> None:
        """Raises BadInput: a number is out of range, or the replay buffer never holds what is waited for."""
        in_range(
            self,
            positive="iterations episodes updates epsilon_iterations disseminate validate_every save_every",
            not_negative="prefill warm_up warm_up_after validation",
        )
        if self.recorded_first > WAITS * self.replay.capacity:
            problem = f"nothing is learned before {self.recorded_first} decisions are kept"
            raise BadInput(problem, field="training.replay.capacity", value=self.replay.capacity)

    @property
    def recorded_first(self) -> int:
        """Decisions that are recorded before the first update; A2C learns on-policy, but for imitation."""
        imitates = (self.a2c if self.learning == "a2c" else self.ddqn).imitation > 0.0
        if imitates:
            return max(self.prefill, self.warm_up_after)
        return 0 if self.learning == "a2c" else self.prefill


class Drive(NamedTuple):
    """One episode to be driven; its outcome depends on nothing else."""

    lesson: Lesson
    seed: int
    svo: float  # rad
    epsilon: float
    weights: str  # file of the learning AVs' network, "" for untrained
    frozen: str  # file of the others'
    record: bool  # False: validation, greedy, nothing is recorded
    guided: bool = False  # by the demonstrator
    errors: str = ""  # of the human drivers
    preset: str = Preset.UNGUARDED
    attempt: int = 0  # of those with the same traffic and learners (`A2cConfig.attempts`)
    keep: int = 0  # decisions that an action drawn from the preferences is kept; 0: epsilon-greedy
    floor: float = 0.0  # share of these draws that are even (`A2cConfig.floor`)


class Drove(NamedTuple):
    """What came of it."""

    trajectories: list[Trajectory]
    figures: dict[str, float | None]  # crashed, mission_success, dt_..., reward (a decision and AV), steps


def drives(c: VfnTraining, k: int, weights: str, frozen: str, epsilon: float, guided: float) -> list[Drive]:
    """The episodes of iteration `k`; `guided`: the share of them that the demonstrator drives."""
    drawn = []
    attempts, keep, floor = (c.a2c.attempts, c.a2c.keep, c.a2c.floor) if c.learning == "a2c" else (1, 0, 0.0)
    for j in range(c.episodes):
        draws = [uniform(c.seed, name, str(k), str(j)) for name in ("lesson", "svo", "guided")]
        lesson = _drawn(c.lessons, draws[0])
        drive = Drive(
            lesson,
            (k * c.episodes + j + subseed(c.seed, "episodes")) % len(TRAINING_SEEDS),
            math.radians(c.svo[int(draws[1] * len(c.svo))]),
            epsilon,
            weights,
            frozen,
            record=True,
            guided=draws[2] < guided,
            errors=c.errors if uniform(c.seed, "errors", str(k), str(j)) < c.erring else "",
            preset=lesson.preset or c.preset,
            keep=keep,
            floor=floor,
        )
        # the demonstrator tries nothing
        drawn += [drive._replace(attempt=i) for i in range(1 if drive.guided else attempts)]
    return drawn


def judged(c: VfnTraining, k: int) -> bool:
    """Whether the weights that iteration `k` begins with are validated."""
    return (k % c.validate_every == 0 and k > 0) or k + 1 == c.iterations


def validation(c: VfnTraining, weights: str) -> list[Drive]:
    """Every lesson in turn, greedy, on tuning seeds; where humans err in some drives, in every second one."""
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
            errors=c.errors if c.erring == 1.0 or j % 2 else "",
            preset=lesson.preset or c.preset,
        )
        for lesson in c.lessons
        for j in range(c.validation)
    ]


def interpolated(c: VfnTraining, ends: tuple[float, float], k: int) -> float:
    """Between `ends`, linear over `epsilon_iterations`, then the last."""
    first, last = ends
    return first + (last - first) * min(k / c.epsilon_iterations, 1.0)


def _drawn(lessons: Sequence[Lesson], at: float) -> Lesson:
    """The lesson at `at` (0 to 1) of the weights laid end to end."""
    edges = np.cumsum([lesson.weight for lesson in lessons])
    return lessons[int(np.searchsorted(edges / edges[-1], at, side="right").clip(0, len(lessons) - 1))]
