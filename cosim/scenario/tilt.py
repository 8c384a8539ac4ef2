"""A tilt: human errors drawn more often than they happen, and what an episode so drawn weighs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import sumo_scenarios
from cosim.errors import BadInput, one_of
from cosim.files import yaml_input
from cosim.scenario.human_errors import KINDS
from cosim.seeding import uniform

MOST = 0.5  # of a tilted probability: both outcomes of a trial stay likely
UNTILTED = 0.1  # share of episodes that are drawn as errors happen: no episode weighs more than 1 / UNTILTED
ALL = "all"  # kinds that are not named
OTHER = ".other"  # errors that do not meet an AV first
SECOND = ".second"  # of those near somebody who errs, whomever they meet
CASES = tuple(kind + ending for kind in (*KINDS, ALL) for ending in ("", OTHER, SECOND))


@dataclass(frozen=True, slots=True)
class Tilt:
    """The first two errors near AVs are drawn more often, in all but a share of the episodes.

    Importance sampling with a defensive mixture (Hesterberg, Technometrics 37 (1995) 185-194; Owen and Zhou,
    JASA 95 (2000) 135-143): docs/guides/estimate.md.
    """

    factors: Mapping[str, float] = field(default_factory=dict)  # `case` -> factor, 1 or more
    during: float = 1.0  # times that of the first, for a second error whose own factor is not named
    untilted: float = UNTILTED

    def raises(self, kind: str) -> bool:
        """Whether any trial of this kind is tilted."""
        endings = "", OTHER, SECOND
        return self.during > 1.0 or any((self._factor(kind, e) or 1.0) > 1.0 for e in endings)

    def rate(self, kind: str, p: float, meets_av: bool = True, second: bool = False) -> float:
        """q, the tilted probability of a trial that is p as it happens."""
        factor = self._factor(kind, SECOND) if second else None
        if factor is None:
            first = self._factor(kind, "" if meets_av else OTHER) or 1.0
            factor = first * (self.during if second else 1.0)
        return max(p, min(p * factor, MOST))

    def _factor(self, kind: str, ending: str) -> float | None:
        return self.factors.get(kind + ending, self.factors.get(ALL + ending))

    def drawn(self, seed: int) -> bool:
        """Whether the episode of this seed is drawn from the tilted probabilities."""
        return uniform(seed, "tilt") >= self.untilted

    def weight(self, log_ratio: float) -> float:
        """p over the mixture's probability of an episode: 1 / (a + (1 - a) q / p)."""
        return 1.0 / (self.untilted + (1.0 - self.untilted) * math.exp(min(log_ratio, 700.0)))

    def text(self) -> str:
        """`cut_in=300,forced_entry=30,untilted=0.1`; `read` is the way back."""
        named = [*sorted(self.factors.items()), ("during", self.during), ("untilted", self.untilted)]
        return ",".join(f"{name}={value:g}" for name, value in named)


def case(kind: str, meets_av: bool, second: bool = False) -> str:
    """What a factor is for: a kind; with `OTHER` its errors that do not meet an AV first."""
    return kind + (SECOND if second else "" if meets_av else OTHER)


def log_ratio(p: float, q: float, begins: bool) -> float:
    """What one trial adds to log(q / p) of its episode: the logarithm of q/p or of (1-q)/(1-p)."""
    if q == p:
        return 0.0
    return math.log(q / p) if begins else math.log1p(-q) - math.log1p(-p)


def read(text: str, where: str = "--tilt") -> Tilt:
    """The tilt of a `text()`. Raises BadInput: not of that form, a factor below 1, a share that is none."""
    factors: dict[str, float] = {}
    for part in filter(None, map(str.strip, text.split(","))):
        name, equals, number = part.partition("=")
        try:
            factors[name.strip()] = float(number) if equals else math.nan
        except ValueError:
            factors[name.strip()] = math.nan
        if not math.isfinite(factors[name.strip()]):
            problem = "write KIND=FACTOR,... as in cut_in=100,forced_entry=30,untilted=0.1"
            raise BadInput(problem, field=where, value=part)
    during, share = factors.pop("during", 1.0), factors.pop("untilted", UNTILTED)
    if not 0.0 < share <= 1.0:
        raise BadInput("must be above 0 and at most 1", field=f"{where}.untilted", value=share)
    for name, factor in {**factors, "during": during}.items():
        one_of(name, (*CASES, "during"), where)
        if factor < 1.0:
            raise BadInput("must be 1 or more", field=f"{where}.{name}", value=factor)
    return Tilt(dict(sorted(factors.items())), during, share)


@lru_cache
def shipped(world: str) -> Tilt | None:
    """The tilt of the level `field` in a world that ships; None where none was made."""
    found = yaml_input.document(sumo_scenarios.TILTS).get(world)
    return None if found is None else read(str(found["tilt"]), world)
