"""Buildings as flat arrays for the line-of-sight kernel."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cosim.arrays import Floats, Ints


class Walls(NamedTuple):
    """The concatenated outlines of k polygons."""

    begin: Ints  # [k+1] first point of each polygon
    points: Floats  # [p,2] m; a polygon's first point is repeated as its last
    centre: Floats  # [k,2] m
    radius: Floats  # [k] m, from the centre to the furthest point


def walls(polygons: Sequence[Floats]) -> Walls:
    """The walls of polygons [.,2] (m); open polygons are closed."""
    closed = [np.concatenate([shape, shape[:1]]) for shape in polygons if len(shape) > 1]
    centre = np.array([0.5 * (shape.min(0) + shape.max(0)) for shape in closed]).reshape(-1, 2)
    radius = [np.hypot(*(shape - c).T).max() for shape, c in zip(closed, centre, strict=True)]
    return Walls(
        np.cumsum([0, *map(len, closed)], dtype=np.int64),
        np.concatenate(closed) if closed else np.zeros((0, 2)),
        centre,
        np.array(radius, np.float64),
    )
