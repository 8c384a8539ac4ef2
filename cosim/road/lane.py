"""One lane of the road."""

from dataclasses import dataclass

from cosim.arrays import Floats


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
    speed_limit: float  # m/s
    successors: tuple[int, ...] = ()  # lanes that follow directly (internal lanes included)
    left: int = -1
    right: int = -1
    internal: bool = False  # lies inside a junction
    start: str = ""  # junction where its edge begins (its own junction for an internal lane)
    end: str = ""  # junction where its edge ends
