"""Links: connections of lanes through junctions, with signals and right of way."""

import math
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np

from cosim.arrays import Floats


class Rule(IntEnum):
    """The rule at a stop line without signals (SUMO, Networks/SUMO_Road_Networks, link states)."""

    PRIORITY = 0  # foes yield
    YIELD = 1  # yield to the link's foes; also a link with signals that are off or green without priority
    STOP = 2  # stop, then yield
    ALL_WAY_STOP = 3  # stop; first stopped, first served
    EQUAL = 4  # yield to the right (to the left in left-hand traffic)
    ZIPPER = 5  # alternate


@dataclass(frozen=True, slots=True)
class Link:
    """One connection; lanes are indices into `RoadMap.lanes`. The stop line is the end of lane `origin`."""

    origin: int
    via: int  # first internal lane, -1 without one
    target: int
    signal: int  # index into `Snapshot.signals`, -1 without a signal
    rule: Rule
    foes: tuple[int, ...] = ()  # indices of the links with right of way over this link


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """A pedestrian crossing."""

    id: str
    shape: Floats  # [p,2] m, its centre line
    width: float  # m
    lanes: tuple[int, ...]  # crossed lanes
    signal: int = -1  # index into `Snapshot.signals`

    def away(self, x: Floats, y: Floats) -> Floats:
        """[n] m from positions x, y [n] m to the centre line."""
        distance = np.full(len(x), np.inf)
        for (ax, ay), (bx, by) in pairwise(self.shape.tolist()):
            length = max(math.hypot(bx - ax, by - ay), 1e-6)
            ux, uy = (bx - ax) / length, (by - ay) / length
            t = np.clip((x - ax) * ux + (y - ay) * uy, 0.0, length)
            distance = np.minimum(distance, np.hypot(x - ax - t * ux, y - ay - t * uy))
        return distance
