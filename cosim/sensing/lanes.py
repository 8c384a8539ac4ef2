"""The lanes of a road as flat arrays for kernels."""

from typing import NamedTuple

import numpy as np

from cosim.arrays import Floats, Ints
from cosim.road import RoadMap


class LaneLines(NamedTuple):
    """Concatenated centre lines of the l lanes of `RoadMap.lanes`, and their successors."""

    begin: Ints  # [l+1] first point of each lane
    points: Floats  # [p,3] x m, y m, m along the lane
    scale: Floats  # [l] m along the centre line per m of SUMO's lane positions
    following: Ints  # [l] successor lane, -1: none
    length: Floats  # [l] m, SUMO's


def lane_lines(road: RoadMap) -> LaneLines:
    """The lanes of `road`; the successor is the straightest, because routes are unknown."""
    lines = []
    for lane in road.lanes:
        steps = np.hypot(*np.diff(lane.shape[:, :2], axis=0).T)
        lines.append(np.column_stack([lane.shape[:, :2], np.concatenate([[0.0], np.cumsum(steps)])]))
    counts = [len(line) for line in lines]
    points = np.concatenate(lines) if lines else np.zeros((0, 3))
    ends = np.array([line[-1, 2] for line in lines], np.float64)
    following, length = road.straight_on
    return LaneLines(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.ascontiguousarray(points, np.float64),
        ends / np.maximum(length, 1e-6),
        following,
        length,
    )
