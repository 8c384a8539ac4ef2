"""Importance sampling of errors near AVs: raises trial probabilities and accumulates likelihood ratios."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from cosim.scenario.tilt import Tilt, case, log_ratio
from cosim.simulation.backend import sumo
from cosim.types import ERROR_MEMORY, Bools

TILT_RADIUS = 60.0  # m around an AV, in which errors may be tilted
MAX_TILTED_ERRORS = 2  # per episode, drawn from raised probabilities


class Tilted:
    """The tilt of one episode.

    The first error near an AV is tilted, and a second one near that erring driver; later ones are not.
    """

    def __init__(self, tilt: Tilt | None, seed: int) -> None:
        self._tilt = tilt
        self._drawn = tilt is not None and tilt.drawn(seed)
        self.log_ratio = 0.0  # of the trials so far
        self.weighed: dict[str, list[float]] = {}  # `case` -> errors begun, sum of p of its trials
        self._near: frozenset[str] = frozenset()  # vehicles with weighted trials
        self._during: frozenset[str] = frozenset()  # of these, near an erring driver
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
        """Call before the trials of a second. `erring`: erring drivers; `ended`: end times of errors, s."""
        if self._tilt is not None and self._begun < MAX_TILTED_ERRORS:
            recent = {driver for driver, end in ended.items() if now - end <= ERROR_MEMORY}
            known = [name for name in names if name in erring or name in recent]
            self._near, self._during = _beside_avs(names, avs, known)

    @property
    def active(self) -> bool:
        """Whether any trial of this second is weighted."""
        return bool(self._near) and self._begun < MAX_TILTED_ERRORS

    def weighs(self, driver: str) -> bool:
        """Whether this driver's trials are weighted."""
        return driver in (self._near, self._during, ())[min(self._begun, MAX_TILTED_ERRORS)]

    def probability(self, driver: str, kind: str, p: float, drawn: float, meets_av: bool) -> float:
        """The probability to use for a trial of natural probability `p`; updates `log_ratio` and
        `weighed`."""
        if self._tilt is None or not self.weighs(driver):
            return p
        second = self._begun > 0
        q = self._tilt.rate(kind, p, meets_av, second)
        used = q if self._drawn else p
        begins = bool(drawn < used)
        self.log_ratio += log_ratio(p, q, begins)
        counted = self.weighed.setdefault(case(kind, meets_av, second), [0, 0.0])
        counted[0] += begins
        counted[1] += float(p)
        self._begun += begins and q > p
        return used


def _beside_avs(
    names: Sequence[str], avs: set[str], erring: Sequence[str]
) -> tuple[frozenset[str], frozenset[str]]:
    """The vehicles within `TILT_RADIUS` of an AV, and of these the ones near another of `erring`."""
    if not (avs and names):
        return frozenset(), frozenset()
    places = {name: sumo.vehicle.getPosition(name) for name in (*names, *avs)}

    def close(to: Sequence[str]) -> Bools:
        """[n,t]"""
        here, there = (np.array([places[k] for k in group]).reshape(-1, 2) for group in (names, to))
        return np.asarray(np.abs(here[:, None] - there).max(2) < TILT_RADIUS)

    def selected(mask: Bools) -> frozenset[str]:
        return frozenset(name for name, is_so in zip(names, mask.tolist(), strict=True) if is_so)

    near = np.asarray(close([*avs]).any(1))
    others = np.array(names)[:, None] != np.array(erring, str)
    return selected(near), selected(near & (close(erring) & others).any(1))
