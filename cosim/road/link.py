"""Ways through junctions: which lane leads to which, by which signal, and who has the right of way."""

import math
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np

from cosim.arrays import Floats


class Rule(IntEnum):
    """What the sign at a stop line asks for (SUMO, Networks/SUMO_Road_Networks, link states)."""

    PRIORITY = 0  # nothing: others give way
    YIELD = 1  # give way to the link's foes; also a link with signals that are off or green without priority
    STOP = 2  # stop, then give way
    ALL_WAY_STOP = 3  # stop; who stopped first goes first
    EQUAL = 4  # the right before the left (the left before the right in left-hand traffic)
    ZIPPER = 5  # by turns


@dataclass(frozen=True, slots=True)
class Link:
    """One connection; lanes are indices into `RoadMap.lanes`. The stop line is where lane `origin` ends."""

    origin: int
    via: int  # the first lane inside the junction, -1 where there is none
    target: int
    signal: int  # index into `Snapshot.signals`, -1 without a signal
    rule: Rule
    foes: tuple[int, ...] = ()  # indices of the links that have the right of way over this one


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """A pedestrian crossing."""

    id: str
    shape: Floats  # [p,2] m, its centre line
    width: float  # m
    lanes: tuple[int, ...]  # the lanes that it crosses
    signal: int = -1  # index into `Snapshot.signals`

    def away(self, x: Floats, y: Floats) -> Floats:
        """[n] m from places x, y [n] m to its centre line."""
        distance = np.full(len(x), np.inf)
        for (ax, ay), (bx, by) in pairwise(self.shape.tolist()):
            length = max(math.hypot(bx - ax, by - ay), 1e-6)
            ux, uy = (bx - ax) / length, (by - ay) / length
            t = np.clip((x - ax) * ux + (y - ay) * uy, 0.0, length)
            distance = np.minimum(distance, np.hypot(x - ax - t * ux, y - ay - t * uy))
        return distance
