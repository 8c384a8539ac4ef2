"""Human drivers as data: P's Table II and its LC2013 mapping, read from sumo_scenarios/behaviors.yaml."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from statistics import NormalDist

import sumo_scenarios
from cosim.errors import BadInput
from cosim.files import yaml_input
from cosim.files.yaml_input import Section

AS_IS = "as-is"  # the behaviour of nobody: vehicles drive as their file says
MIXED = "mixed"
LC2013, MOBIL = DRIVER_MODELS = ("lc2013", "mobil")

# What LC2013 of SUMO 1.28 really has (SUMO reads any other name in a vType without a word).
LC2013_ATTRIBUTES = frozenset(
    (
        "lcStrategic",
        "lcStrategicLookahead",
        "lcCooperative",
        "lcCooperativeSpeed",
        "lcCooperativeRoundabout",
        "lcSpeedGain",
        "lcSpeedGainRight",
        "lcSpeedGainLookahead",
        "lcSpeedGainRemainTime",
        "lcKeepRight",
        "lcKeepRightAcceptanceTime",
        "lcOpposite",
        "lcAssertive",
        "lcLookaheadLeft",
        "lcOvertakeRight",
        "lcOvertakeDeltaSpeedFactor",
        "lcSigma",
        "lcMaxSpeedLatStanding",
        "lcMaxSpeedLatFactor",
        "lcMaxDistLatStanding",
    )
)


@dataclass(frozen=True, slots=True)
class IdmParameters:
    """Longitudinal half of Table II."""

    time_headway: float  # s, T
    minimum_gap: float  # m, d0, bumper to bumper
    max_acceleration: float  # m/s2, a_max
    comfortable_deceleration: float  # m/s2, a_des


@dataclass(frozen=True, slots=True)
class MobilParameters:
    """Lateral half of Table II."""

    politeness: float  # p
    threshold: float  # m/s2, a_th
    safe_deceleration: float  # m/s2, b_safe


@dataclass(frozen=True, slots=True)
class DesiredSpeed:
    """Distribution of the desired speed as a factor on the speed limit: normal, clipped."""

    mean: float
    deviation: float
    minimum: float
    maximum: float

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
    mobil_period: float  # s

    @property
    def names(self) -> tuple[str, ...]:
        """What `--behavior` accepts."""
        return (*self.classes, MIXED, AS_IS)

    def draw(self, behavior: str, u: float) -> DriverClass:
        """The class at quantile `u` in [0, 1) of a behaviour: one class, or the mixture."""
        if behavior != MIXED:
            return self.classes[behavior]
        return self.classes[next((name for name, share in self.mixed if u < share), self.mixed[-1][0])]


@lru_cache
def load_behaviors(path: Path = sumo_scenarios.BEHAVIORS) -> Behaviors:
    """Read behaviors.yaml (default: the one that ships with the worlds).

    Raises BadInput naming file, field and value.
    """
    top = yaml_input.read(path, ("desired_speed", "mixed", "mobil_period", "classes"))
    named = top.keys("classes")
    for reserved in (MIXED, AS_IS):
        if reserved in named:
            raise BadInput("is not the name of a class", file=path, field="classes", value=reserved)
    given = top.section("classes", named)
    classes = {name: _driver_class(name, given.section(name, ("mobil", "idm", "lc2013"))) for name in named}
    shares = top.section("mixed", classes)
    weights = {name: shares.needed(name, low=0.0) for name in top.keys("mixed")}
    total = sum(weights.values())
    if total <= 0.0:
        raise BadInput("the shares are all 0", file=path, field="mixed")
    cumulated, so_far = [], 0.0
    for name, weight in weights.items():
        so_far += weight / total
        cumulated.append((name, so_far))
    names = _names(DesiredSpeed)
    speed = top.section("desired_speed", names)
    desired = DesiredSpeed(*(speed.needed(n, low=0.0, above=n != "deviation") for n in names))
    if not desired.minimum <= desired.mean <= desired.maximum:
        problem = "must lie between minimum and maximum"
        raise BadInput(problem, file=path, field="desired_speed.mean", value=desired.mean)
    return Behaviors(classes, tuple(cumulated), desired, top.needed("mobil_period", low=0.0, above=True))


# ---- inside ----


def _driver_class(name: str, given: Section) -> DriverClass:
    idm = given.section("idm", _names(IdmParameters))
    rule = given.section("mobil", _names(MobilParameters))
    lane_changes = given.section("lc2013", LC2013_ATTRIBUTES)
    return DriverClass(
        name,
        IdmParameters(*(idm.needed(n, low=0.0, above=True) for n in _names(IdmParameters))),
        MobilParameters(
            rule.needed("politeness", low=0.0),
            rule.needed("threshold", low=0.0),
            rule.needed("safe_deceleration", low=0.0, above=True),
        ),
        tuple((n, lane_changes.needed(n, low=-1.0)) for n in given.keys("lc2013")),
    )


def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))
