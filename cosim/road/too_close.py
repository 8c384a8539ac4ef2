"""Net faults: lanes so close together that vehicles overlap although each keeps its own lane."""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from cosim.arrays import Floats
from cosim.road import RoadMap

BUS_WIDTH = 2.5  # m, SUMO's widest road vehicles
SPACING = 2.0  # m between the points compared


def heed_each_other(road: RoadMap, a: int, b: int) -> bool:
    """Whether drivers on lanes `a` and `b` (indices) have to heed one another. True for lanes that are
    equal, consecutive, diverge, merge or cross, and for links of which one yields to the other."""
    if along_one_another(road, a, b) or _cross(road.lanes[a].shape, road.lanes[b].shape):
        return True
    ways = [road.links_through.get(lane, ()) for lane in (a, b)]
    return any(m in road.links[k].foes or k in road.links[m].foes for k in ways[0] for m in ways[1])


def along_one_another(road: RoadMap, a: int, b: int) -> bool:
    """Whether two lanes (indices) are equal, consecutive, or diverge or merge at one point."""
    near = [{lane, *road.lanes[lane].successors, *road.before[lane]} for lane in (a, b)]
    return not near[0].isdisjoint(near[1])


def walks_beside(road: RoadMap, place: int) -> bool:
    """Whether a place (`Snapshot.place`) is a walking area. Persons there are off the road, and vehicles and
    persons do not heed one another (SUMO: Simulation/Pedestrians)."""
    edge = road.contact.edge(place)
    return edge.startswith(":") and edge.rpartition("_")[2].startswith("w")


def foot(road: RoadMap, lane: int, behind: float, rear: Floats) -> list[int]:
    """The lanes under a vehicle: the lane of its front, and the lanes before.

    `behind`: m of the vehicle before `lane`. `rear`: [2] m, the rear end, to choose among preceding lanes.
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
    """Pairs of lanes (indices) of one edge, less than `BUS_WIDTH` apart, whose drivers need not heed
    each other; with the distance of the centre lines in m, the closest first."""
    found = []
    for a, b in _neighbours(road):
        if not heed_each_other(road, a, b):
            p, q = _points(road.lanes[a].shape), _points(road.lanes[b].shape)
            distance = float(np.hypot(*(p[:, None] - q[None]).transpose(2, 0, 1)).min())
            if distance < BUS_WIDTH:
                found.append((distance, a, b))
    return sorted(found)


def described(road: RoadMap, pairs: Sequence[tuple[float, int, int]], most: int = 3) -> str:
    """`too_close` in one line that names at most `most` pairs; "" for none."""
    if not pairs:
        return ""
    named = [f"{road.lanes[a].id} and {road.lanes[b].id} ({d:.2f} m)" for d, a, b in pairs[:most]]
    more = f" and {len(pairs) - most} more pairs" if len(pairs) > most else ""
    return (
        f"less than {BUS_WIDTH:g} m apart, so that vehicles overlap without a collision: "
        f"{', '.join(named)}{more}"
    )


# ---- inside ----


def _neighbours(road: RoadMap) -> Iterator[tuple[int, int]]:
    """Pairs of lanes of one edge, internal or not."""
    edges: dict[str, list[int]] = {}
    for k, lane in enumerate(road.lanes):
        edges.setdefault(lane.edge, []).append(k)
    for each in edges.values():
        yield from combinations(each, 2)


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
