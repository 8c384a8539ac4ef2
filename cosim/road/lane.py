"""One lane of the road."""

from dataclasses import dataclass

from cosim.arrays import Floats

FASTEST_ROAD = 150.0  # m/s: a file that lets a lane be faster says that it has no limit
NO_LIMIT = 200.0 / 3.6  # m/s, SUMO's default for the top speed of a car: what such a lane counts as


@dataclass(frozen=True)
class Lane:
    """One SUMO lane. Index 0 of an edge is the rightmost; `left`/`right`/`successors` index RoadMap.lanes.

    `left` and `right` are lanes that a car may change to; -1 where there is none or the change is forbidden.
    """

    id: str
    edge: str
    index: int
    shape: Floats  # [p,2] m, centre line
    length: float  # m, SUMO's length: lane positions run from 0 to here
    width: float  # m
    speed_limit: float  # m/s; `NO_LIMIT` where there is none
    successors: tuple[int, ...] = ()  # lanes that follow directly (internal lanes included)
    left: int = -1
    right: int = -1
    internal: bool = False  # lies inside a junction
    start: str = ""  # junction where its edge begins (its own junction for an internal lane)
    end: str = ""  # junction where its edge ends


def limit(speed: float) -> float:
    """The speed limit in m/s of a lane whose file names this one."""
    return speed if speed <= FASTEST_ROAD else NO_LIMIT
