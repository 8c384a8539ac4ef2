"""A claim as a file: `research/claims/NAME.yaml`, read and checked before the first episode.

An arm is a mapping of options (`cosim.scenario.options.OPTIONS`, by the names of SPEC.yaml) over those that
all arms share. Every arm is driven in every condition: a scenario with one value of each option in `matrix`.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import sumo_scenarios
from cosim.errors import BadInput, inside, one_of
from cosim.files.yaml_input import Positive, check_known, dataclass_from, document
from cosim.policies import check
from cosim.scenario import with_preset
from cosim.scenario.options import OPTIONS, EpisodeOptions

FOLDER = Path(__file__).parent / "claims"
FIRST_SEED = 300_000  # lower test seeds had been used before the networks were trained
SCENARIO, POLICY = "scenario", "policy"
ARM_OPTIONS = tuple(name for name in OPTIONS if name != SCENARIO)  # options that a claim may set


class Condition(NamedTuple):
    """The traffic of all arms: a scenario, and a value of every option in the matrix."""

    scenario: str
    values: tuple[tuple[str, Any], ...] = ()

    @property
    def text(self) -> str:
        """`errors stress, demand dense`; "" where the matrix is empty."""
        return ", ".join(f"{name} {value}" for name, value in self.values)


@dataclass(frozen=True)
class Seeds:
    """The episodes of every arm and condition."""

    first: int
    count: int
    more: Mapping[str, int] = field(default_factory=dict)  # scenario -> count, if different


@dataclass(frozen=True)
class Compare:
    """The arm of the claim and the arms compared with it, on equal seeds."""

    arm: str
    against: tuple[str, ...]


@dataclass(frozen=True)
class Primary:
    """The figure of the claim, by its name in reports, and the claimed direction."""

    metric: str
    direction: Literal["lower", "higher"]

    @property
    def sign(self) -> float:
        """The sign of the claimed difference."""
        return 1.0 if self.direction == "higher" else -1.0


@dataclass(frozen=True)
class Power:
    """The smallest effect of interest, in the metric's unit (shares: a fraction), and the required pairs."""

    smallest: Positive
    pairs: int


@dataclass(frozen=True)
class Claim:
    """One claim: the definition of its episodes, tests and page.

    Raises BadInput naming the field and the value.
    """

    name: str  # of the file, the page and the CSV
    sentence: str  # the claim; the page answers yes, no or unresolved
    source: str  # paper and figure
    scenarios: tuple[str, ...]
    seeds: Seeds
    arms: Mapping[str, Mapping[str, Any]]
    compare: Compare
    primary: Primary
    test: Literal["mcnemar", "signed_rank"]  # of cosim.report.statistics
    power: Power
    holds: Literal["everywhere", "somewhere"] = "everywhere"  # comparisons in which the claim must hold
    options: Mapping[str, Any] = field(default_factory=dict)  # of all arms
    matrix: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)  # option -> its values
    pool: tuple[str, ...] = ()  # options of the matrix whose values count together, as one condition
    floors: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # additional arms without a test
    secondary: tuple[str, ...] = ()  # metrics
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # scenario -> arm -> value
    front: tuple[str, ...] = ()  # metrics: the picture plots the others against the first
    note: str = ""  # a remark for the page

    def __post_init__(self) -> None:
        for scenario in (*self.scenarios, *self.published, *self.seeds.more):
            one_of(scenario, sumo_scenarios.shipped(), "scenarios")
        for arm in (self.compare.arm, *self.compare.against):
            one_of(arm, self.arms, "compare")
        for scenario, values in self.published.items():
            for arm in values:
                one_of(arm, self.every_arm, f"published.{scenario}")
        for option in self.pool:
            one_of(option, self.matrix, "pool")
        if len(self.front) == 1:
            raise BadInput("two metrics or more are needed", field="front", value=self.front[0])
        self._check_seeds()
        assert self.cases  # every option is read once

    @property
    def every_arm(self) -> dict[str, Mapping[str, Any]]:
        """Arms and floors."""
        return {**self.arms, **self.floors}

    @property
    def conditions(self) -> list[Condition]:
        """Scenario by scenario within each combination of the matrix."""
        axes = [[(name, value) for value in values] for name, values in self.matrix.items()]
        return [Condition(s, values) for values in itertools.product(*axes) for s in self.scenarios]

    def pooled(self, condition: Condition) -> Condition:
        """The condition without the options that count together."""
        return condition._replace(values=tuple(v for v in condition.values if v[0] not in self.pool))

    @property
    def metrics(self) -> tuple[str, ...]:
        """Every figure that the claim names, each once."""
        return tuple(dict.fromkeys((self.primary.metric, *self.secondary, *self.front)))

    @property
    def digest(self) -> str:
        """The first digits of the SHA-256 of all that the file defines."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:12]

    @cached_property
    def cases(self) -> dict[tuple[Condition, str], EpisodeOptions]:
        """The options of every arm in every condition, with the first seed."""
        return {
            (condition, arm): self._case(condition, arm)
            for condition in self.conditions
            for arm in self.every_arm
        }

    def seeds_of(self, scenario: str) -> range:
        """The seeds that every arm drives in a scenario."""
        first = self.seeds.first
        return range(first, first + self.seeds.more.get(scenario, self.seeds.count))

    # ---- inside ----

    def _check_seeds(self) -> None:
        if self.seeds.first < FIRST_SEED:
            problem = f"the seeds of a claim start at {FIRST_SEED} or above"
            raise BadInput(problem, field="seeds.first", value=self.seeds.first)
        together = math.prod(len(self.matrix[option]) for option in self.pool)
        fewest = together * min([self.seeds.count, *self.seeds.more.values()])
        if not 0 < self.power.pairs <= fewest:
            problem = f"must be between 1 and {fewest}, the number of episodes in a condition"
            raise BadInput(problem, field="power.pairs", value=self.power.pairs)

    def _case(self, condition: Condition, arm: str) -> EpisodeOptions:
        kind = "arms" if arm in self.arms else "floors"
        own = self.every_arm[arm]
        if twice := own.keys() & self.matrix.keys():
            raise BadInput("is set by the matrix already", field=f"{kind}.{arm}.{min(twice)}")
        parts = {"options": self.options, "matrix": dict(condition.values), f"{kind}.{arm}": own}
        values = {
            name: value for place, given in parts.items() for name, value in _read(given, place).items()
        }
        if "policy" not in values:
            raise BadInput("is missing", field=f"{kind}.{arm}.{POLICY}")
        return with_preset(EpisodeOptions(condition.scenario, **values, seed=self.seeds.first))


def names(folder: Path = FOLDER) -> list[str]:
    """The names of all claims."""
    return sorted(path.stem for path in folder.glob("*.yaml"))


def read(path: Path) -> Claim:
    """The claim in a file. Raises BadInput naming file, field and value."""
    given = document(path)
    with inside("", path):
        check_known(given, (name for name in Claim.__dataclass_fields__ if name != "name"))
    return dataclass_from(Claim, {**given, "name": path.stem}, path)


def chosen(wanted: Iterable[str], folder: Path = FOLDER) -> Iterator[Claim]:
    """The claims of these names; all if none is named. Raises BadInput."""
    known = names(folder)
    for name in [*wanted] or known:
        one_of(name, known, "NAME")
        yield read(folder / f"{name}.yaml")


def _read(given: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Fields of `EpisodeOptions` from what the file says under `place`."""
    with inside(place):
        check_known(given, ARM_OPTIONS)
        found = {OPTIONS[name].field: OPTIONS[name].read(v, FOLDER, name) for name, v in given.items()}
        if POLICY in given:
            check(given[POLICY], POLICY)
        return found
