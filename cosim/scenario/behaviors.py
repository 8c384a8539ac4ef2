"""Human driver classes: P's Table II and its LC2013 mapping, read from sumo_scenarios/behaviors.yaml."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from statistics import NormalDist
from typing import Annotated

import sumo_scenarios
from cosim.errors import BadInput, Range, inside, one_of
from cosim.files import yaml_input
from cosim.files.yaml_input import NonNegative, Positive
from cosim.scenario.vet_rules import LC2013 as LC2013_ATTRIBUTES

AS_IS = "as-is"  # no Table II class: vehicles drive as their file says
MIXED = "mixed"
LC2013, MOBIL = DRIVER_MODELS = ("lc2013", "mobil")


@dataclass(frozen=True, slots=True)
class IdmParameters:
    """Longitudinal half of Table II."""

    time_headway: Positive  # s, T
    minimum_gap: Positive  # m, d0, bumper to bumper
    max_acceleration: Positive  # m/s2, a_max
    comfortable_deceleration: Positive  # m/s2, a_des


@dataclass(frozen=True, slots=True)
class MobilParameters:
    """Lateral half of Table II."""

    politeness: NonNegative  # p
    threshold: NonNegative  # m/s2, a_th
    safe_deceleration: Positive  # m/s2, b_safe


@dataclass(frozen=True, slots=True)
class DesiredSpeed:
    """Clipped normal distribution of the desired speed, as a factor of the speed limit."""

    mean: Positive
    deviation: NonNegative
    minimum: Positive
    maximum: Positive

    def __post_init__(self) -> None:
        if not self.minimum <= self.mean <= self.maximum:
            raise BadInput("must lie between minimum and maximum", field="mean", value=self.mean)

    def draw(self, u: float) -> float:
        """The factor at quantile `u` in (0, 1)."""
        if self.deviation == 0.0:
            return self.mean
        return min(max(NormalDist(self.mean, self.deviation).inv_cdf(u), self.minimum), self.maximum)


@dataclass(frozen=True, slots=True)
class DriverClass:
    """One column of Table II and its LC2013 attributes."""

    name: str
    idm: IdmParameters
    mobil: MobilParameters
    lc2013: tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Behaviors:
    """behaviors.yaml."""

    classes: Mapping[str, DriverClass]
    mixed: tuple[tuple[str, float], ...]  # class, cumulated share; the last is 1
    desired_speed: DesiredSpeed
    mobil_period: Positive  # s

    @property
    def names(self) -> tuple[str, ...]:
        """What `--behavior` accepts."""
        return (*self.classes, MIXED, AS_IS)

    def draw(self, behavior: str, u: float) -> DriverClass:
        """The class at quantile `u` in [0, 1) of a behavior: one class, or the mixture."""
        if behavior != MIXED:
            return self.classes[behavior]
        return self.classes[next((name for name, share in self.mixed if u < share), self.mixed[-1][0])]


@dataclass(frozen=True, slots=True)
class _WrittenClass:
    mobil: MobilParameters
    idm: IdmParameters
    lc2013: Mapping[str, Annotated[float, Range(-1.0)]]

    def __post_init__(self) -> None:
        with inside("lc2013"):
            yaml_input.check_known(self.lc2013, LC2013_ATTRIBUTES)  # SUMO ignores any other name silently


@dataclass(frozen=True, slots=True)
class _Written:
    """behaviors.yaml as written."""

    desired_speed: DesiredSpeed
    mixed: Mapping[str, NonNegative]  # class -> share, of any sum
    mobil_period: Positive
    classes: Mapping[str, _WrittenClass]


@lru_cache
def load_behaviors(path: Path = sumo_scenarios.BEHAVIORS) -> Behaviors:
    """Read behaviors.yaml (default: the shipped file).

    Raises BadInput naming file, field and value.
    """
    top = yaml_input.read(path, _Written)
    for reserved in {MIXED, AS_IS} & top.classes.keys():
        raise BadInput("is not the name of a class", file=path, field="classes", value=reserved)
    for name in top.mixed:
        one_of(name, top.classes, "mixed", path)
    total = sum(top.mixed.values())
    if total <= 0.0:
        raise BadInput("the shares are all 0", file=path, field="mixed")
    return Behaviors(
        {n: DriverClass(n, c.idm, c.mobil, tuple(c.lc2013.items())) for n, c in top.classes.items()},
        tuple(zip(top.mixed, accumulate(share / total for share in top.mixed.values()), strict=True)),
        top.desired_speed,
        top.mobil_period,
    )
