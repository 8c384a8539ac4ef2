"""Importance sampling of errors near AVs: raises the probability of a trial, counts what that weighs."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from cosim.scenario.tilt import Tilt, case, log_ratio
from cosim.simulation.backend import sumo
from cosim.types import ERROR_MEMORY, Bools

TILT_RADIUS = 60.0  # m: within that of an AV errors may be tilted
MAX_TILTED_ERRORS = 2  # errors from raised probabilities in an episode


class Tilted:
    """The tilt of one episode.

    Near an AV the first error is tilted, and a second one near a driver who errs then; no further ones.
    """

    def __init__(self, tilt: Tilt | None, seed: int) -> None:
        self._tilt = tilt
        self._drawn = tilt is not None and tilt.drawn(seed)
        self.log_ratio = 0.0  # of the trials so far
        self.weighed: dict[str, list[float]] = {}  # `case` -> errors begun, sum of p of its trials
        self._near: frozenset[str] = frozenset()  # vehicles whose trials are weighed
        self._during: frozenset[str] = frozenset()  # of these, near a driver who errs
        self._begun = 0  # errors from raised probabilities

    def raises(self, kind: str) -> bool:
        """Whether any trial of this kind is tilted."""
        return self._tilt is not None and self._tilt.raises(kind)

    def look(
        self,
        names: Sequence[str],
        avs: set[str],
        erring: Collection[str],
        ended: Mapping[str, float],
        now: float,
    ) -> None:
        """Before the trials of a second. `erring`: drivers who err; `ended`: s, when earlier errors ended."""
        if self._tilt is not None and self._begun < MAX_TILTED_ERRORS:
            recent = {who for who, end in ended.items() if now - end <= ERROR_MEMORY}
            known = [name for name in names if name in erring or name in recent]
            self._near, self._during = _beside_avs(names, avs, known)

    @property
    def active(self) -> bool:
        """Whether any trial of this second is weighed."""
        return bool(self._near) and self._begun < MAX_TILTED_ERRORS

    def weighs(self, who: str) -> bool:
        """Whether the trials of `who` are weighed."""
        return who in (self._near, self._during, ())[min(self._begun, MAX_TILTED_ERRORS)]

    def probability(self, who: str, kind: str, p: float, drawn: float, meets_av: bool) -> float:
        """The probability that holds for a trial that is `p` as it happens; `log_ratio` and `weighed` take it
        in."""
        if self._tilt is None or not self.weighs(who):
            return p
        second = self._begun > 0
        q = self._tilt.rate(kind, p, meets_av, second)
        held = q if self._drawn else p
        begins = bool(drawn < held)
        self.log_ratio += log_ratio(p, q, begins)
        counted = self.weighed.setdefault(case(kind, meets_av, second), [0, 0.0])
        counted[0] += begins
        counted[1] += float(p)
        self._begun += begins and q > p
        return held


def _beside_avs(
    names: Sequence[str], avs: set[str], erring: Sequence[str]
) -> tuple[frozenset[str], frozenset[str]]:
    """The vehicles within `TILT_RADIUS` of an AV; and of those the ones within it of another of `erring`."""
    if not (avs and names):
        return frozenset(), frozenset()
    places = {name: sumo.vehicle.getPosition(name) for name in (*names, *avs)}

    def close(to: Sequence[str]) -> Bools:
        """[n,t]"""
        here, there = (np.array([places[k] for k in group]).reshape(-1, 2) for group in (names, to))
        return np.asarray(np.abs(here[:, None] - there).max(2) < TILT_RADIUS)

    def those(mask: Bools) -> frozenset[str]:
        return frozenset(name for name, is_so in zip(names, mask.tolist(), strict=True) if is_so)

    near = np.asarray(close([*avs]).any(1))
    others = np.array(names)[:, None] != np.array(erring, str)
    return those(near), those(near & (close(erring) & others).any(1))
