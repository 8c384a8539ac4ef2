"""Random roads that are full: what is chosen or learned is chosen on these, never on the test roads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from cosim.seeding import TUNING_SEEDS
from sumo_scenarios.draw import draw, write
from sumo_scenarios.roads import NAMED

FULL = 1.0  # share of the nominal capacity that is wanted at least
LARGEST = 2500.0  # vehicles/h wanted at most: a drive of twice the vehicles costs more than two drives show
EACH = 4  # roads of a kind
KINDS = tuple(NAMED)


class FullRoad(NamedTuple):
    """A scenario and the seed that drew it, which is its traffic's too."""

    seed: int
    kind: str
    folder: Path


def full_roads(
    each: int, folder: Path, kinds: Collection[str] = KINDS, seeds: Iterable[int] = TUNING_SEEDS
) -> Iterator[FullRoad]:
    """The first full roads of the seeds, `each` of these kinds, written to `folder`."""
    wanted = Counter(dict.fromkeys(kinds, each))
    for seed in seeds:
        drawn = draw(seed)
        if drawn.level >= FULL and drawn.per_hour <= LARGEST and wanted[drawn.road.kind]:
            wanted[drawn.road.kind] -= 1
            yield FullRoad(seed, drawn.road.kind, write(seed, folder))
        if not wanted.total():
            return
