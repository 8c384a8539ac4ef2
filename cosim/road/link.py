"""Ways through junctions: which lane leads to which, by which signal, and who has the right of way."""

from dataclasses import dataclass
from enum import IntEnum

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
