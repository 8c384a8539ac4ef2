"""Buildings as flat arrays, for the kernel of the line of sight."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cosim.arrays import Floats, Ints


class Walls(NamedTuple):
    """The outlines of k polygons, one after the other."""

    begin: Ints  # [k+1] where each polygon's points begin
    points: Floats  # [p,2] m; the first one of a polygon comes again as its last
    centre: Floats  # [k,2] m
    radius: Floats  # [k] m, from there to the furthest point


def walls(polygons: Sequence[Floats]) -> Walls:
    """The walls of polygons [.,2] (m), each closed where it is open."""
    closed = [np.concatenate([shape, shape[:1]]) for shape in polygons if len(shape) > 1]
    centre = np.array([0.5 * (shape.min(0) + shape.max(0)) for shape in closed]).reshape(-1, 2)
    radius = [np.hypot(*(shape - c).T).max() for shape, c in zip(closed, centre, strict=True)]
    return Walls(
        np.cumsum([0, *map(len, closed)], dtype=np.int64),
        np.concatenate(closed) if closed else np.zeros((0, 2)),
        centre,
        np.array(radius, np.float64),
    )
