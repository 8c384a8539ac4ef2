"""Lanes so close together that vehicles on them overlap though each follows its own: a fault of the net."""

from collections.abc import Iterator

import numpy as np

from cosim.arrays import Floats
from cosim.road import RoadMap

BROAD = 2.5  # m: SUMO's broadest vehicles on the road, buses
SPACING = 2.0  # m between the points compared


def heed_each_other(road: RoadMap, a: int, b: int) -> bool:
    """Whether drivers on lanes `a` and `b` (indices) have to heed one another: one lane, or one after the
    other, or two that part, join or cross."""
    near = [{lane, *road.lanes[lane].successors, *road.before[lane]} for lane in (a, b)]
    return not near[0].isdisjoint(near[1]) or _cross(road.lanes[a].shape, road.lanes[b].shape)


def foot(road: RoadMap, lane: int, behind: float, rear: Floats) -> list[int]:
    """The lanes that a vehicle stands on: the one of its front, and those before it.

    `behind`: m of the vehicle that are before the beginning of `lane`; `rear`: [2] m, its rear end, which
    says by which of several lanes it came.
    """
    found = [lane]
    while behind > 0.0 and (before := road.before[found[-1]]):
        came = min(before, key=lambda k: float(np.hypot(*(_points(road.lanes[k].shape) - rear).T).min()))
        if came in found:
            break
        found.append(came)
        behind -= road.lanes[came].length
    return found


def too_close(road: RoadMap) -> list[tuple[float, int, int]]:
    """Pairs of lanes (indices) on which vehicles of `BROAD` m side by side overlap though their drivers need
    not heed each other, with the distance of their centre lines in m, the closest first."""
    found: dict[tuple[int, int], float] = {}
    points = {k: _points(lane.shape) for k, lane in enumerate(road.lanes)}
    for a, b in _neighbours(road):
        if (a, b) in found or heed_each_other(road, a, b):
            continue
        p, q = points[a], points[b]
        distance = float(np.hypot(*(p[:, None] - q[None]).transpose(2, 0, 1)).min())
        if distance < BROAD:
            found[a, b] = distance
    return sorted((d, a, b) for (a, b), d in found.items())


# ---- inside ----


def _neighbours(road: RoadMap) -> Iterator[tuple[int, int]]:
    """Pairs of lanes beside one another on an edge, or of one junction."""
    edges: dict[str, list[int]] = {}
    junctions: dict[str, set[int]] = {}
    for k, lane in enumerate(road.lanes):
        edges.setdefault(lane.edge, []).append(k)
        if lane.internal:
            junctions.setdefault(lane.start, set()).add(k)
    for lanes in (*edges.values(), *junctions.values()):
        each = sorted(lanes)
        yield from ((a, b) for n, a in enumerate(each) for b in each[n + 1 :])


def _points(shape: Floats) -> Floats:
    """[k,2] m, points along a line at most `SPACING` apart."""
    step = np.hypot(*np.diff(shape, axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(step)])
    at = np.linspace(0.0, arc[-1], max(int(np.ceil(arc[-1] / SPACING)) + 1, 2))
    return np.stack([np.interp(at, arc, shape[:, 0]), np.interp(at, arc, shape[:, 1])], axis=1)


def _cross(p: Floats, q: Floats) -> bool:
    """Whether two lines [k,2] and [l,2] cross."""
    a, b = p[:-1, None], p[1:, None]  # [k-1,1,2]
    c, d = q[None, :-1], q[None, 1:]  # [1,l-1,2]

    def side(o: Floats, u: Floats, v: Floats) -> Floats:
        first, second = u - o, v - o
        return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]

    return bool(((side(a, b, c) * side(a, b, d) < 0.0) & (side(c, d, a) * side(c, d, b) < 0.0)).any())
