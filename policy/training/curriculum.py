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
class ForkConfig:
    """Copies of the simulation in which AVs do otherwise (`cosim.learning.forks`)."""

    count: int = 0  # a drive
    held: int = 6  # decisions for which the other action is held
    horizon: int = 40  # decisions over which the difference that it makes is summed up
    together: int = 1  # AVs that do so in one copy: as many as drawn, from 1 to this
    meeting: float = 0.0  # share of the copies whose AVs come nearest a mission vehicle where their ways meet

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(self, positive="held horizon together", not_negative="count", share="meeting")


@dataclass(frozen=True, slots=True)
class Specialist:
    """Weights that alone teach what was driven in one world."""

    world: str  # SCENARIO/DEMAND
    file: str
    met: bool = False  # only AVs whose way meets a mission vehicle's
    others: bool = False  # only what an action brings the others: what it brings oneself stays as taught
    weight: float = 1.0  # of what an action brings the others
    # deg: at which phi its pupil is to turn to yielding, and at which phi who drives by the file turns
    # (`benchmarks.turn`)
    turn: tuple[float, float] = (45.0, 45.0)

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range, and an angle that is none between 0 and 90 degrees."""
        in_range(self, positive="weight")
        if not all(0.0 < angle < 90.0 for angle in self.turn):
            problem = "two angles between 0 and 90 degrees are needed"
            raise BadInput(problem, field="turn", value=list(self.turn))


@dataclass(frozen=True, slots=True)
class EnsembleConfig:
    """Several networks that learn from all that was driven, and one that is taught their mean
    (`policy.training.ensemble`)."""

    networks: int = 0  # that learn from the replay buffer
    by_copies: int = 0  # further ones, which learn with `DdqnConfig.by_copies`
    copies: float = 8.0  # weight of the copies there, in place of `DdqnConfig.forked`
    shrink: float = 1.0  # there, in place of `DdqnConfig.shrink`
    updates: int = 5_000  # of each, from the weights that the training began with
    teachers: tuple[str, ...] = ()  # files of weights that count in the mean besides; one twice: twice
    distillation: int = 5_000  # updates of the one that is taught
    refused: float = 1.0  # weight of the refused actions' loss, in place of `DdqnConfig.refused`
    n_step: int = 8  # in place of `ReplayConfig.n_step`
    # deg: the largest phi that a teacher is asked with; a larger one is taught as this one
    most: float = 90.0
    specialists: tuple[Specialist, ...] = ()
    runs: tuple[str, ...] = ()  # folders of other trainings whose drives are learned from besides
    drives: tuple[str, ...] = ()  # SCENARIO/DEMAND whose drives count once more; named twice: twice more
    # the one that is taught learns in these layers alone (`VfnConfig.meets`, `.assisted`), from the AVs that
    # they drive; all others are driven by the first weights, to the bit
    alone: Literal["", "met", "assisted"] = ""

    def __post_init__(self) -> None:
        """Raises BadInput for a number out of range."""
        in_range(
            self,
            positive="updates distillation n_step",
            not_negative="networks by_copies copies shrink refused",
        )
        if not 45.0 <= self.most <= 90.0:
            raise BadInput("must be an angle from 45 to 90 degrees", field="most", value=self.most)

    def __bool__(self) -> bool:
        """Whether there is anything to learn from."""
        return bool(self.networks or self.by_copies or self.teachers)


@dataclass(frozen=True, slots=True)
class VfnTraining:
    """One training run. Defaults: what trains on two CPU cores (docs/training.md)."""

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
    preset: str = Preset.UNGUARDED  # what the car does by itself (docs/definitions.md, Presets)
    encoder: str = (
        ""  # weights of `cosim train encoder`, for a network of extractor `frames`: encoder, or a file
    )
    first: str = ""  # weights to begin with, a file; "": drawn from the seed
    code: tuple[str, ...] = ()  # their files and SHA-256
    forks: ForkConfig = field(default_factory=ForkConfig)
    ensemble: EnsembleConfig = field(default_factory=EnsembleConfig)  # after the last iteration
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    ddqn: DdqnConfig = field(default_factory=DdqnConfig)
    a2c: A2cConfig = field(default_factory=A2cConfig)

    def __post_init__(self) -> None:
        """Raises BadInput: a number is out of range, no lesson drives a world of the ensemble, there are no
        copies to learn from, or the replay buffer never holds what is waited for."""
        in_range(
            self,
            positive="iterations episodes updates epsilon_iterations disseminate validate_every save_every",
            not_negative="prefill warm_up warm_up_after validation",
        )
        if self.ensemble and not self.validation:
            raise BadInput("an ensemble is judged by validation", field="training.validation", value=0)
        imitates = (self.a2c if self.learning == "a2c" else self.ddqn).imitation > 0.0
        waits = max(self.prefill, self.warm_up_after) if imitates else self.prefill
        if waits > WAITS * self.replay.capacity and not self.ensemble:
            problem = f"nothing is learned before {waits} decisions are kept"
            raise BadInput(problem, field="training.replay.capacity", value=self.replay.capacity)
        if not self.replay.forked and (self.ddqn.by_copies or self.ensemble.by_copies):
            problem = "nothing is learned by copies without any in a batch"
            raise BadInput(problem, field="training.replay.forked", value=0)
        driven = {f"{lesson.scenario}/{lesson.demand}" for lesson in self.lessons}
        named = [("drives", name) for name in self.ensemble.drives]
        named += [("specialists", one.world) for one in self.ensemble.specialists]
        for part, name in named:
            if name not in driven:
                problem = f"no lesson drives it; lessons: {', '.join(sorted(driven))}"
                raise BadInput(problem, field=f"training.ensemble.{part}", value=name)


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
    forks: ForkConfig = ForkConfig()
    gamma: float = 1.0  # that what forks change is discounted with
    attempt: int = 0  # of those with the same traffic and learners (`A2cConfig.attempts`)


class Drove(NamedTuple):
    """What came of it."""

    trajectories: list[Trajectory]
    figures: dict[str, float | None]  # crashed, mission_success, dt_..., reward (a decision and AV), steps


def drives(c: VfnTraining, k: int, weights: str, frozen: str, epsilon: float, guided: float) -> list[Drive]:
    """The episodes of iteration `k`; `guided`: the share of them that the demonstrator drives."""
    drawn = []
    attempts = c.a2c.attempts if c.learning == "a2c" else 1
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
            forks=c.forks,
            gamma=c.replay.gamma,
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
