"""Random validation roads that are full: what is chosen is chosen on these, never on the test roads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cosim.seeding import TUNING_SEEDS
from sumo_scenarios.draw import draw, write

FULL = 1.0  # share of the nominal capacity that is wanted at least
ROADS = 12  # of a benchmark


class FullRoad(NamedTuple):
    """A scenario and the seed that drew it, which is its traffic's too."""

    seed: int
    kind: str
    folder: Path


def full_roads(count: int, folder: Path, kinds: tuple[str, ...] = ()) -> Iterator[FullRoad]:
    """The first `count` full roads of the validation seeds, written to `folder`; `kinds`: empty for all."""
    found = 0
    for seed in TUNING_SEEDS:
        drawn = draw(seed)
        if drawn.level < FULL or (kinds and drawn.road.kind not in kinds):
            continue
        if found == count:
            return
        found += 1
        yield FullRoad(seed, drawn.road.kind, write(seed, folder))
