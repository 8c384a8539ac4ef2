"""One lane of the road."""

from dataclasses import dataclass

from cosim.arrays import Floats

FASTEST_ROAD = 150.0  # m/s; a file's higher speed means no speed limit
NO_LIMIT = 200.0 / 3.6  # m/s, SUMO's default top speed of a car, for lanes without a limit


@dataclass(frozen=True)
class Lane:
    """One SUMO lane. Index 0 of an edge is the rightmost; `left`/`right`/`successors` index RoadMap.lanes.

    `left` and `right` are lanes that a car may change to; -1: no lane, or a forbidden change.
    """

    id: str
    edge: str
    index: int
    shape: Floats  # [p,2] m, centre line
    length: float  # m, SUMO's length: lane positions run from 0 to here
    width: float  # m
    speed_limit: float  # m/s; `NO_LIMIT` without one
    successors: tuple[int, ...] = ()  # lanes that follow directly (internal lanes included)
    left: int = -1
    right: int = -1
    internal: bool = False  # lies inside a junction
    start: str = ""  # junction at the edge's beginning (of an internal lane: the junction around it)
    end: str = ""  # junction at the edge's end


def limit(speed: float) -> float:
    """The speed limit (m/s) of a lane with this `speed` in the net file."""
    return speed if speed <= FASTEST_ROAD else NO_LIMIT
