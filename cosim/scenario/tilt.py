"""A tilt: importance sampling of human errors, with raised probabilities and episode weights."""

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

MAX_TILTED_PROBABILITY = 0.5  # so that both outcomes of a trial stay likely
UNTILTED = 0.1  # share of episodes with natural probabilities; bounds the weights by 1 / UNTILTED
ALL = "all"  # kinds without a factor of their own
OTHER = ".other"  # errors that do not affect an AV first
SECOND = ".second"  # errors near another erring driver, whichever vehicle they affect
CASES = tuple(kind + ending for kind in (*KINDS, ALL) for ending in ("", OTHER, SECOND))


@dataclass(frozen=True, slots=True)
class Tilt:
    """The first two errors near AVs have raised probabilities, in all but a share of the episodes.

    Importance sampling with a defensive mixture (Hesterberg, Technometrics 37 (1995) 185-194; Owen and Zhou,
    JASA 95 (2000) 135-143): docs/guides/estimate.md.
    """

    factors: Mapping[str, float] = field(default_factory=dict)  # `case` -> factor, 1 or more
    during: float = 1.0  # for a second error without a factor: multiple of the first error's factor
    untilted: float = UNTILTED

    def raises(self, kind: str) -> bool:
        """Whether any trial of this kind is tilted."""
        endings = "", OTHER, SECOND
        return self.during > 1.0 or any((self._factor(kind, e) or 1.0) > 1.0 for e in endings)

    def rate(self, kind: str, p: float, meets_av: bool = True, second: bool = False) -> float:
        """q, the tilted probability of a trial with natural probability p."""
        factor = self._factor(kind, SECOND) if second else None
        if factor is None:
            first = self._factor(kind, "" if meets_av else OTHER) or 1.0
            factor = first * (self.during if second else 1.0)
        return max(p, min(p * factor, MAX_TILTED_PROBABILITY))

    def _factor(self, kind: str, ending: str) -> float | None:
        return self.factors.get(kind + ending, self.factors.get(ALL + ending))

    def drawn(self, seed: int) -> bool:
        """Whether the episode of this seed uses the tilted probabilities."""
        return uniform(seed, "tilt") >= self.untilted

    def weight(self, log_ratio: float) -> float:
        """Importance weight of an episode, p over the mixture's probability: 1 / (a + (1 - a) q / p)."""
        return 1.0 / (self.untilted + (1.0 - self.untilted) * math.exp(min(log_ratio, 700.0)))

    def text(self) -> str:
        """`cut_in=300,forced_entry=30,untilted=0.1`; `read` is the inverse."""
        named = [*sorted(self.factors.items()), ("during", self.during), ("untilted", self.untilted)]
        return ",".join(f"{name}={value:g}" for name, value in named)


def case(kind: str, meets_av: bool, second: bool = False) -> str:
    """The name of a factor: the kind, with `OTHER` for errors that do not affect an AV first."""
    return kind + (SECOND if second else "" if meets_av else OTHER)


def log_ratio(p: float, q: float, begins: bool) -> float:
    """The contribution of a trial to the episode's log(q / p): log of q/p or of (1-q)/(1-p)."""
    if q == p:
        return 0.0
    return math.log(q / p) if begins else math.log1p(-q) - math.log1p(-p)


def read(text: str, where: str = "--tilt") -> Tilt:
    """Parse a `text()`. Raises BadInput: malformed, a factor below 1, or an invalid share."""
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
def shipped(scenario: str) -> Tilt | None:
    """The shipped tilt of level `field` in a scenario; None: there is none."""
    found = yaml_input.document(sumo_scenarios.TILTS).get(scenario)
    return None if found is None else read(str(found["tilt"]), scenario)
