"""Oriented boxes and the conflict measures built on them: one place for the mask, the reward and the report.

Every measure treats a vehicle as its oriented rectangle (`Boxes`) that drives on in a straight line along
its heading. Two rectangles overlap exactly when their projections overlap on all four edge normals
(separating axis theorem, Gottschalk et al. 1996, "OBBTree"), so under constant velocities the time of first
contact is the latest of the four entry times, provided that it lies before the earliest of the four exit
times. Cars that pass in the next lane therefore have no time to collision at all, where a radial measure
(distance over closing speed) would warn. All inputs broadcast: [k,1] boxes against [1,n] boxes give [k,n].
"""

from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from cosim.geometry import kernels
from cosim.geometry.kernels import encroachment
from cosim.road import LaneGraph
from cosim.types import Bools, Floats, Ints, Snapshot

Number = float | npt.NDArray[Any]
INF = np.inf
_Course = tuple[Any, Any, Any, Any, Any, Any, Any]  # x, y, cos and sin of the heading, speed, sizes
EVERYWHERE: Bools = np.ones((1, 1), np.bool_)  # one road, on which all can touch


class Boxes(NamedTuple):
    """Oriented rectangles that drive along their heading; arrays of any broadcastable shapes."""

    x: Number  # m, centre
    y: Number  # m, centre
    heading: Number  # rad, counter-clockwise from east
    length: Number  # m, along the heading
    width: Number  # m
    speed: Number = 0.0  # m/s, along the heading


def boxes(snapshot: Snapshot, rows: npt.NDArray[Any] | None = None) -> Boxes:
    """The n vehicles of a snapshot as boxes (m, rad, m/s); with `rows` [k] only these, in this order."""
    s = snapshot
    columns = s.x, s.y, s.heading, s.length, s.width, s.speed
    return Boxes(*(columns if rows is None else (column[rows] for column in columns)))


def overlap(a: Boxes, b: Boxes) -> Bools:
    """Whether the rectangles of `a` and `b` overlap; touching edges do not.

    Args:
        a, b: boxes of shapes that broadcast, e.g. [k,1] and [n]; speeds do not matter.

    Returns:
        bool of the broadcast shape (separating axis theorem, Gottschalk et al. 1996).
    """
    with _no_float_warnings():
        return cast(Bools, kernels.overlap_ufunc(*_poses(a), *_poses(b)))


def overlapping_pairs(all_boxes: Boxes) -> Ints:
    """Every pair of the n boxes that overlaps.

    Args:
        all_boxes: n boxes, each field [n] (a scalar holds for all).

    Returns:
        [p,2] rows of the p pairs, the lower row first, in ascending order.
    """
    return kernels.pairs_overlap(_table(all_boxes))


def time_to_collision(a: Boxes, b: Boxes, cap: float = INF) -> Floats:
    """Time to collision: until the swept rectangles first touch while both keep their velocity.

    Args:
        a, b: boxes of shapes that broadcast.
        cap: s, the result where they never touch, or only later.

    Returns:
        s, of the broadcast shape, float64; 0 where the boxes overlap already.
    """
    with _no_float_warnings():
        return cast(Floats, kernels.ttc_ufunc(*_motions(a), *_motions(b), cap))


def first_contacts(a: Boxes, b: Boxes, dt: float) -> Floats:
    """When one vehicle, on each of k courses, first touches each of n others.

    Args:
        a: its courses: x, y, heading, speed [k,t] (m, rad, m/s); one length and one width, m.
        b: the others: x, y, heading, speed [n,t]; length and width [n] m.
        dt: s between frames. Between two of them, and for `dt` after the last one, boxes keep their
            velocity, so that no contact between two frames is missed.

    Returns:
        [k,n] s from the first frame on, inf without a contact.
    """
    mine: _Course = (a.x, a.y, np.cos(a.heading), np.sin(a.heading), a.speed, a.length, a.width)
    theirs: _Course = (b.x, b.y, np.cos(b.heading), np.sin(b.heading), b.speed, b.length, b.width)
    return kernels.first_contacts(*mine, *theirs, dt)


def deceleration_to_avoid_crash(a: Boxes, b: Boxes) -> Floats:
    """DRAC (deceleration rate to avoid a crash) of boxes `a` and `b`, in m/s2, of their broadcast shape.

    The smallest constant deceleration with which one of the two, braking alone along its heading while the
    other keeps its velocity, avoids every overlap of the swept rectangles. When the follower of an aligned
    pair brakes this is dv^2 / (2 gap) (Almqvist et al. 1991; SUMO's SSM device); when paths cross it is what
    lets the other clear the crossing first, or stops short of it. Oncoming pairs (headings more than
    135 degrees apart), where one alone cannot help, may share the braking:
    (v_a^2 + v_b^2) / (2 closing distance). 0 without a time to collision below 120 s, inf where they overlap.
    """
    with _no_float_warnings():
        return cast(Floats, kernels.drac_ufunc(*_motions(a), *_motions(b)))


class Conflicts(NamedTuple):
    """The conflicts of one moment: the worst of each of k watched vehicles, and the grave ones of all."""

    rows: Ints  # [k]
    time_to_collision: Floats  # [k] s, the smallest; the horizon when there is none
    deceleration: Floats  # [k] m/s2, the largest finite DRAC; 0 without a conflict or when overlapping only
    soon: Ints  # [p,2] rows of the pairs, watched or not, with a time to collision above 0 and below `soon`
    hard: Ints  # [q,2] rows of those with a finite DRAC above `hard`, the lower row first


def conflicts(
    all_boxes: Boxes,
    watched: Bools,
    horizon: float = 10.0,
    roads: tuple[Ints, Bools] | None = None,
    *,
    soon: float = 0.0,
    hard: float = INF,
) -> Conflicts:
    """Conflicts of the n vehicles with one another.

    The same as `time_to_collision` and `deceleration_to_avoid_crash` over all pairs, in one pass.

    Args:
        all_boxes: n boxes, each field [n].
        watched: [n] whose worst conflicts are wanted.
        horizon: s, how far ahead.
        roads: each vehicle's road [n] and which roads can touch [S,S] (`cosim.road.contact`); None: all can.
        soon: s, of the time to collision.
        hard: m/s2, of the DRAC.
    """
    x, y, heading, length, width, speed = (np.asarray(v, dtype=np.float64) for v in all_boxes)
    number, touch = (np.zeros(len(x), np.int64), EVERYWHERE) if roads is None else roads
    course = x, y, heading, length, width, speed
    return Conflicts(
        *kernels.conflicts(*course, watched, float(horizon), number, touch, float(soon), float(hard))
    )


def gap_ahead(
    snapshot: Snapshot, graph: LaneGraph, rows: npt.NDArray[Any], reach: float = 125.0
) -> tuple[Floats, Ints]:
    """Bumper-to-bumper gap to the next vehicle in the same corridor, and that vehicle's row.

    The corridor is the vehicle's lane and the lanes that follow it straight on.

    Args:
        snapshot: the n vehicles.
        graph: which lane follows which (`RoadMap.straight_on`).
        rows: [k] the vehicles whose gap is wanted.
        reach: m, how far ahead.

    Returns:
        gap [k] m: inf without a leader within `reach`, negative when bumpers overlap;
        row of the leader [k], -1 without one.
    """
    vehicles = snapshot.lane, snapshot.lane_position, snapshot.length
    return kernels.lane_gaps(*vehicles, np.asarray(rows, np.int64), *graph, float(reach))


def headway(gap: Floats, speed: Floats, slowest: float = 0.5) -> Floats:
    """Net time headway gap / speed (bumper to bumper).

    Args:
        gap: [k] m, inf without a leader.
        speed: [k] m/s.
        slowest: m/s, at or below which the headway is inf: a quotient would only measure a queue.

    Returns:
        [k] s, inf without a leader.
    """
    return np.where(speed > slowest, np.maximum(gap, 0.0) / np.maximum(speed, slowest), INF)


def post_encroachment_time(a: Boxes, b: Boxes, interval: float, longest: float = 5.0) -> float:
    """Post-encroachment time (PET) of two trajectories, in s.

    Args:
        a, b: trajectories, each field [T] (m, rad, m/s), NaN while absent; sizes may be scalars.
        interval: s between samples.
        longest: s, the longest PET that counts.

    The time from the moment the first vehicle leaves a spot to the moment the second reaches it (Allen et
    al. 1978), smallest over all spots; inf when there is none up to `longest` s. Only spots count where the
    headings differ by more than 15 degrees: crossing and merging, not following. Between samples the vehicles
    move at constant velocity, so the result does not depend on the sampling to first order.
    """
    trail = np.stack([_trail(a), _trail(b)], axis=1)  # [T,2,6]
    sizes = np.array([[np.max(v.length), np.max(v.width)] for v in (a, b)], dtype=np.float64)  # [2,2] m
    relevant = np.ones(2, dtype=np.bool_)
    back = int(np.ceil(longest / interval))
    best = INF
    for t in range(1, len(trail)):
        window = trail[max(0, t - back) : t + 1]
        best = min(
            best, float(encroachment(window, len(window) - 1, 2, sizes, relevant, interval, EVERYWHERE)[0])
        )
    return best if best <= longest else INF


def _no_float_warnings() -> np.errstate:
    """The compiler evaluates branches that are not taken, which raises floating-point flags without need."""
    return np.errstate(invalid="ignore", divide="ignore", over="ignore")


def _trail(b: Boxes) -> Floats:
    heading = np.asarray(b.heading, dtype=np.float64)
    parts = np.broadcast_arrays(b.x, b.y, np.cos(heading), np.sin(heading), b.speed, 0.0)
    return np.stack(parts, axis=-1).astype(np.float64)  # [T,6]


def _poses(b: Boxes) -> tuple[Any, ...]:
    return b.x, b.y, np.cos(b.heading), np.sin(b.heading), b.length, b.width


def _motions(b: Boxes) -> tuple[Any, ...]:
    return *_poses(b), b.speed


def _table(b: Boxes) -> Floats:
    table = np.empty((np.size(b.x), 7), dtype=np.float64)
    for k, column in enumerate(_motions(b)):
        table[:, k] = column
    return table
