"""Oriented boxes and the conflict measures built on them: one place for the mask, the reward and the report.

Every measure treats a vehicle as its oriented rectangle (`Boxes`) that drives on in a straight line along
its heading. Two rectangles overlap exactly when their projections overlap on all four edge normals
(separating axis theorem, Gottschalk et al. 1996, "OBBTree"), so under constant velocities the time of first
contact is the latest of the four entry times, provided that it lies before the earliest of the four exit
times. Cars that pass in the next lane therefore have no time to collision at all, where a radial measure
(distance over closing speed) would warn. All inputs broadcast: [k,1] boxes against [1,n] boxes give [k,n].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt

from cosim.road import RoadMap
from cosim.types import Bools, Floats, Ints, Snapshot

Number = float | npt.NDArray[Any]
INF = np.inf

FOLLOWING_COSINE = float(np.cos(np.radians(15.0)))  # headings closer than 15 degrees: following, not crossing
_ONCOMING_COSINE = -float(np.cos(np.radians(45.0)))  # headings more than 135 degrees apart: head-on
_PARALLEL = 1e-12  # m/s or cosine below which a projection counts as standing still
_HORIZON = 120.0  # s, how far ahead `deceleration_to_avoid_crash` looks


class Boxes(NamedTuple):
    """Oriented rectangles that drive along their heading; arrays of any broadcastable shapes."""

    x: Number  # m, centre
    y: Number  # m, centre
    heading: Number  # rad, counter-clockwise from east
    length: Number  # m, along the heading
    width: Number  # m
    speed: Number = 0.0  # m/s, along the heading


def boxes(snapshot: Snapshot, rows: npt.NDArray[Any] | None = None) -> Boxes:
    """The vehicles of a snapshot ([n], or [k] with `rows`) as boxes; m, rad, m/s."""
    s = snapshot
    if rows is None:
        return Boxes(s.x, s.y, s.heading, s.length, s.width, s.speed)
    return Boxes(s.x[rows], s.y[rows], s.heading[rows], s.length[rows], s.width[rows], s.speed[rows])


def overlap(a: Boxes, b: Boxes) -> Bools:
    """Whether the rectangles of `a` and `b` overlap (touching edges do not); broadcast shape, bool."""
    return cast(Bools, _overlap_ufunc(*_poses(a), *_poses(b)))


def overlapping_pairs(all_boxes: Boxes) -> Ints:
    """Rows of every pair of the n boxes ([n] each) that overlaps: [p,2], the lower row first."""
    return cast(Ints, _overlapping_pairs(*_columns(all_boxes)))


def time_to_collision(a: Boxes, b: Boxes, cap: float = INF) -> Floats:
    """Time until the swept rectangles first touch, in s; broadcast shape.

    Both keep their velocity. 0 where they overlap already; `cap` (default inf) where they never touch or
    only later than `cap`.
    """
    return cast(Floats, _ttc_ufunc(*_motions(a), *_motions(b), cap))


def pairs_time_to_collision(all_boxes: Boxes, rows: npt.NDArray[Any], cap: float = INF) -> Floats:
    """Time to collision of vehicles `rows` [k] with all n vehicles of `all_boxes` ([n] each): [k,n] s.

    A vehicle has `cap` with itself. See `time_to_collision`.
    """
    rows = np.asarray(rows, dtype=np.int64)
    return cast(Floats, _pairs_ttc(*_columns(all_boxes), rows, float(cap)))


def deceleration_to_avoid_crash(a: Boxes, b: Boxes) -> Floats:
    """DRAC (deceleration rate to avoid a crash), in m/s2; broadcast shape.

    The smallest constant deceleration with which one of the two, braking alone along its heading while the
    other keeps its velocity, avoids every overlap of the swept rectangles. When the follower of an aligned
    pair brakes this is dv^2 / (2 gap) (Almqvist et al. 1991; SUMO's SSM device); when paths cross it is what
    lets the other clear the crossing first, or stops short of it. Oncoming pairs (headings more than
    135 degrees apart), where one alone cannot help, may share the braking:
    (v_a^2 + v_b^2) / (2 closing distance). 0 without a time to collision, inf where they overlap.
    """
    return cast(Floats, _drac_ufunc(*_motions(a), *_motions(b)))


class LaneGraph(NamedTuple):
    """Which lane follows which, for walking ahead quickly; l lanes as in RoadMap.lanes."""

    following: Ints  # [l] the lane one drives on to, -1 at the end
    length: Floats  # [l] m


def lane_graph(road: RoadMap) -> LaneGraph:
    """The straightest successor of every lane (another vehicle's route is unknown): [l], [l] m."""
    following = [
        path.lanes[1] if len(path.lanes) > 1 else -1 for path in map(road.path, range(len(road.lanes)))
    ]
    return LaneGraph(
        np.array(following, dtype=np.int64), np.array([lane.length for lane in road.lanes], dtype=np.float64)
    )


def gap_ahead(
    snapshot: Snapshot, graph: LaneGraph, rows: npt.NDArray[Any], reach: float = 125.0
) -> tuple[Floats, Ints]:
    """Bumper-to-bumper gap to the next vehicle in the same corridor and that vehicle's row.

    The corridor is the vehicle's lane and the lanes that follow it. rows [k] -> gap [k] m (inf when nobody
    is within `reach` m, negative when bumpers overlap), leader's row [k] (-1 for nobody).
    """
    s = snapshot
    return cast(
        tuple[Floats, Ints],
        _gap_ahead(s.lane, s.lane_position, s.length, np.asarray(rows, np.int64), *graph, float(reach)),
    )


def headway(gap: Floats, speed: Floats, slowest: float = 0.5) -> Floats:
    """Time headway gap / speed in s (net, bumper to bumper); [k] m, [k] m/s -> [k] s.

    inf without a leader and below `slowest` m/s, where a quotient would only measure standing in a queue.
    """
    return np.where(speed > slowest, np.maximum(gap, 0.0) / np.maximum(speed, slowest), INF)


def post_encroachment_time(a: Boxes, b: Boxes, interval: float, longest: float = 5.0) -> float:
    """PET in s of two trajectories ([T] each, NaN while absent) sampled every `interval` s.

    The time from the moment the first vehicle leaves a spot to the moment the second reaches it (Allen et
    al. 1978), smallest over all spots; inf when there is none up to `longest` s. Only spots count where the
    headings differ by more than 15 degrees: crossing and merging, not following. Between samples the vehicles
    move at constant velocity, so the result does not depend on the sampling to first order.
    """
    trail = np.stack([_trail(a), _trail(b)], axis=1)  # [T,2,5]
    sizes = np.array([[np.max(v.length), np.max(v.width)] for v in (a, b)], dtype=np.float64)  # [2,2] m
    relevant = np.ones(2, dtype=np.bool_)
    back = int(np.ceil(longest / interval))
    best = INF
    for t in range(1, len(trail)):
        window = trail[max(0, t - back) : t + 1]
        best = min(best, float(encroachment(window, len(window) - 1, sizes, relevant, interval)))
    return best if best <= longest else INF


def _trail(b: Boxes) -> Floats:
    heading = np.asarray(b.heading, dtype=np.float64)
    parts = np.broadcast_arrays(b.x, b.y, np.cos(heading), np.sin(heading), b.speed)
    return np.stack(parts, axis=-1).astype(np.float64)  # [T,5]


def _poses(b: Boxes) -> tuple[Any, ...]:
    return b.x, b.y, np.cos(b.heading), np.sin(b.heading), b.length, b.width


def _motions(b: Boxes) -> tuple[Any, ...]:
    return *_poses(b), b.speed


def _columns(b: Boxes) -> tuple[npt.NDArray[Any], ...]:
    shape = np.shape(b.x)
    return tuple(np.ascontiguousarray(np.broadcast_to(m, shape), dtype=np.float64) for m in _motions(b))


# ---- kernels -------------------------------------------------------------------------------------------
# A box is the tuple (x, y, cos heading, sin heading, length, width, speed): m, m, -, -, m, m, m/s.

Box = tuple[float, float, float, float, float, float, float]
_numba = cast(Any, numba)  # its decorators are not typed
Function = TypeVar("Function", bound=Callable[..., Any])


def _compiled(function: Function) -> Function:
    """numba's njit, cached on disk where a cache folder can be written (a read-only image has none)."""
    try:
        return cast(Function, _numba.njit(cache=True, error_model="numpy")(function))
    except RuntimeError:
        return cast(Function, _numba.njit(error_model="numpy")(function))


def _ufunc(inputs: int, result: str) -> Callable[[Function], Function]:
    """A broadcasting numpy ufunc of `inputs` float64 arguments, compiled by numba."""
    signature = f"{result}({', '.join(['float64'] * inputs)})"

    def compile_it(function: Function) -> Function:
        try:
            return cast(Function, _numba.vectorize([signature], cache=True)(function))
        except RuntimeError:
            return cast(Function, _numba.vectorize([signature])(function))

    return compile_it


@_compiled
def _slab(p: float, w: float, r: float) -> tuple[float, float]:
    """When |p + w t| < r: (entry, exit) in s, for a projected distance p m that changes by w m/s."""
    if abs(w) < _PARALLEL:
        if abs(p) < r:
            return -np.inf, np.inf
        return np.inf, -np.inf
    first = (-r - p) / w
    second = (r - p) / w
    return min(first, second), max(first, second)


@_compiled
def _contact(a: Box, b: Box, vx: float, vy: float) -> tuple[float, float]:
    """(entry, exit) in s of two boxes while b drifts by (vx, vy) m/s relative to a."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    c = abs(a[2] * b[2] + a[3] * b[3])
    s = abs(a[2] * b[3] - a[3] * b[2])
    t0, t1 = _slab(dx * a[2] + dy * a[3], vx * a[2] + vy * a[3], 0.5 * (a[4] + b[4] * c + b[5] * s))
    e, x = _slab(dy * a[2] - dx * a[3], vy * a[2] - vx * a[3], 0.5 * (a[5] + b[4] * s + b[5] * c))
    t0, t1 = max(t0, e), min(t1, x)
    e, x = _slab(dx * b[2] + dy * b[3], vx * b[2] + vy * b[3], 0.5 * (b[4] + a[4] * c + a[5] * s))
    t0, t1 = max(t0, e), min(t1, x)
    e, x = _slab(dy * b[2] - dx * b[3], vy * b[2] - vx * b[3], 0.5 * (b[5] + a[4] * s + a[5] * c))
    return max(t0, e), min(t1, x)


@_compiled
def _overlap(a: Box, b: Box) -> bool:
    dx, dy = b[0] - a[0], b[1] - a[1]
    reach = 0.5 * (a[4] + a[5] + b[4] + b[5])  # at least the sum of the half diagonals
    if dx * dx + dy * dy >= reach * reach:
        return False
    c = abs(a[2] * b[2] + a[3] * b[3])
    s = abs(a[2] * b[3] - a[3] * b[2])
    return (
        2.0 * abs(dx * a[2] + dy * a[3]) < a[4] + b[4] * c + b[5] * s
        and 2.0 * abs(dy * a[2] - dx * a[3]) < a[5] + b[4] * s + b[5] * c
        and 2.0 * abs(dx * b[2] + dy * b[3]) < b[4] + a[4] * c + a[5] * s
        and 2.0 * abs(dy * b[2] - dx * b[3]) < b[5] + a[4] * s + a[5] * c
    )


@_compiled
def _ttc(a: Box, b: Box, cap: float) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    vx, vy = b[6] * b[2] - a[6] * a[2], b[6] * b[3] - a[6] * a[3]
    reach = 0.5 * (a[4] + a[5] + b[4] + b[5])  # at least the sum of the half diagonals
    closing = dx * vx + dy * vy
    if closing >= 0.0 and dx * dx + dy * dy >= reach * reach:
        return cap  # apart and drawing away from each other
    miss = dx * vy - dy * vx
    if miss * miss >= reach * reach * (vx * vx + vy * vy) and (vx != 0.0 or vy != 0.0):
        return cap  # the centres' closest approach is too far
    entry, leave = _contact(a, b, vx, vy)
    if entry >= leave or leave <= 0.0:
        return cap
    return min(max(entry, 0.0), cap)


@_compiled
def _needed(t: float, room: float, v: float) -> float:
    """Deceleration (m/s2) with which a car at v m/s has driven at most `room` m at time t s."""
    if room >= v * t:
        return 0.0
    if 2.0 * room >= v * t:
        return 2.0 * (v * t - room) / (t * t)
    return v * v / (2.0 * room) if room > 0.0 else np.inf  # it must stop before t


@_compiled
def _lone_deceleration(a: Box, b: Box) -> float:
    """Smallest constant deceleration of `a` that avoids `b`, which keeps its velocity; inf when none does.

    In the plane of time t and distance s that `a` has driven, the forbidden set is the convex polygon of
    the four slabs |p + w t - g s| < r. Braking must keep s(t) below its lower edge, the greatest of the
    lower lines; what is needed is largest at a corner, or on a line s = p + q t at t = 2 p / (v - q), where
    it is (v - q)^2 / (2 p): the rear-end formula.
    """
    dx, dy = b[0] - a[0], b[1] - a[1]
    ux, uy = b[6] * b[2], b[6] * b[3]
    cosine = a[2] * b[2] + a[3] * b[3]
    sine = a[2] * b[3] - a[3] * b[2]
    c, s = abs(cosine), abs(sine)
    separation = (dx * a[2] + dy * a[3], dy * a[2] - dx * a[3], dx * b[2] + dy * b[3], dy * b[2] - dx * b[3])
    rate = (ux * a[2] + uy * a[3], uy * a[2] - ux * a[3], ux * b[2] + uy * b[3], uy * b[2] - ux * b[3])
    advance = (1.0, 0.0, cosine, -sine)
    radius = (
        0.5 * (a[4] + b[4] * c + b[5] * s),
        0.5 * (a[5] + b[4] * s + b[5] * c),
        0.5 * (b[4] + a[4] * c + a[5] * s),
        0.5 * (b[5] + a[4] * s + a[5] * c),
    )
    low, high, slope = np.empty(4), np.empty(4), np.empty(4)
    lines = 0
    t0, t1 = 0.0, _HORIZON
    for k in range(4):
        g = advance[k]
        if abs(g) < 1e-9:
            e, x = _slab(separation[k], rate[k], radius[k])
            t0, t1 = max(t0, e), min(t1, x)
        else:
            side = radius[k] if g > 0.0 else -radius[k]
            low[lines] = (separation[k] - side) / g
            high[lines] = (separation[k] + side) / g
            slope[lines] = rate[k] / g
            lines += 1
    for i in range(lines):  # the polygon exists only while every lower line is below every upper one
        for j in range(lines):
            e, x = low[i] - high[j], slope[i] - slope[j]
            if x > _PARALLEL:
                t1 = min(t1, -e / x)
            elif x < -_PARALLEL:
                t0 = max(t0, -e / x)
            elif e >= 0.0:
                return 0.0
    if t0 >= t1:
        return 0.0
    v = a[6]
    worst = 0.0
    for i in range(lines):
        for j in range(-3, lines):
            if j == -3:
                t = t0
            elif j == -2:
                t = t1
            elif j == -1:
                t = 2.0 * low[i] / (v - slope[i]) if v > slope[i] else t0
            elif slope[i] != slope[j]:
                t = (low[j] - low[i]) / (slope[i] - slope[j])
            else:
                t = t0
            if t0 <= t <= t1:
                room = low[0] + slope[0] * t
                for k in range(1, lines):
                    room = max(room, low[k] + slope[k] * t)
                worst = max(worst, _needed(t, room, v))
    return worst


@_compiled
def _drac(a: Box, b: Box) -> float:
    ttc = _ttc(a, b, np.inf)
    if ttc <= 0.0:
        return np.inf
    if not ttc < _HORIZON:
        return 0.0
    best = min(_lone_deceleration(a, b), _lone_deceleration(b, a))
    if a[2] * b[2] + a[3] * b[3] < _ONCOMING_COSINE:
        vx, vy = b[6] * b[2] - a[6] * a[2], b[6] * b[3] - a[6] * a[3]
        distance = ttc * np.sqrt(vx * vx + vy * vy)
        best = min(best, (a[6] * a[6] + b[6] * b[6]) / (2.0 * distance))
    return best


# fmt: off
@_ufunc(12, "boolean")
def _overlap_ufunc(
    ax: float, ay: float, ac: float, as_: float, al: float, aw: float,
    bx: float, by: float, bc: float, bs: float, bl: float, bw: float,
) -> bool:
    return _overlap((ax, ay, ac, as_, al, aw, 0.0), (bx, by, bc, bs, bl, bw, 0.0))


@_ufunc(15, "float64")
def _ttc_ufunc(
    ax: float, ay: float, ac: float, as_: float, al: float, aw: float, av: float,
    bx: float, by: float, bc: float, bs: float, bl: float, bw: float, bv: float, cap: float,
) -> float:
    return _ttc((ax, ay, ac, as_, al, aw, av), (bx, by, bc, bs, bl, bw, bv), cap)


@_ufunc(14, "float64")
def _drac_ufunc(
    ax: float, ay: float, ac: float, as_: float, al: float, aw: float, av: float,
    bx: float, by: float, bc: float, bs: float, bl: float, bw: float, bv: float,
) -> float:
    return _drac((ax, ay, ac, as_, al, aw, av), (bx, by, bc, bs, bl, bw, bv))


@_compiled
def _pairs_ttc(
    x: Floats, y: Floats, c: Floats, s: Floats, length: Floats, width: Floats, v: Floats,
    rows: Ints, cap: float,
) -> Floats:
    out = np.empty((len(rows), len(x)))
    for k in range(len(rows)):
        i = rows[k]
        a = (x[i], y[i], c[i], s[i], length[i], width[i], v[i])
        for j in range(len(x)):
            out[k, j] = cap if j == i else _ttc(a, (x[j], y[j], c[j], s[j], length[j], width[j], v[j]), cap)
    return out


@_compiled
def _overlapping_pairs(
    x: Floats, y: Floats, c: Floats, s: Floats, length: Floats, width: Floats, v: Floats
) -> Ints:
    found = []
    for i in range(len(x)):
        a = (x[i], y[i], c[i], s[i], length[i], width[i], v[i])
        for j in range(i + 1, len(x)):
            if _overlap(a, (x[j], y[j], c[j], s[j], length[j], width[j], v[j])):
                found.append((i, j))
    out = np.empty((len(found), 2), dtype=np.int64)
    for k in range(len(found)):
        out[k, 0], out[k, 1] = found[k]
    return out
# fmt: on


@_compiled
def _gap_ahead(
    lane: npt.NDArray[np.int32],
    position: Floats,
    length: Floats,
    rows: Ints,
    following: Ints,
    lane_length: Floats,
    reach: float,
) -> tuple[Floats, Ints]:
    gaps = np.full(len(rows), np.inf)
    leaders = np.full(len(rows), -1, dtype=np.int64)
    for k in range(len(rows)):
        i = rows[k]
        if lane[i] < 0:
            continue
        here = int(lane[i])
        travelled = -position[i]  # m from the front bumper to the start of `here`
        while here >= 0 and travelled <= reach and leaders[k] < 0:
            for j in range(len(lane)):
                ahead = travelled + position[j]
                if lane[j] == here and j != i and ahead > 0.0 and ahead - length[j] < min(gaps[k], reach):
                    gaps[k] = ahead - length[j]
                    leaders[k] = j
            travelled += lane_length[here]
            here = following[here]
    return gaps, leaders


@_compiled
def encroachment(trail: Floats, newest: int, sizes: Floats, relevant: Bools, interval: float) -> float:
    """Smallest post-encroachment time (s, inf for none) that ends at the newest frame of a ring of frames.

    trail [K,m,5] (x m, y m, cos heading, sin heading, speed m/s; NaN while absent), `newest` its newest
    frame, the frame after it (cyclically) the oldest; sizes [m,2] length and width in m; pairs without a
    `relevant` [m] vehicle are left out; `interval` s between frames. See `post_encroachment_time`.
    """
    frames, m = trail.shape[0], trail.shape[1]
    bounds = np.empty((m, 4))  # m, of each vehicle's trail
    for a in range(m):
        bounds[a] = np.inf, -np.inf, np.inf, -np.inf
        for k in range(frames):
            if k != newest and not np.isnan(trail[k, a, 0]):
                bounds[a, 0] = min(bounds[a, 0], trail[k, a, 0])
                bounds[a, 1] = max(bounds[a, 1], trail[k, a, 0])
                bounds[a, 2] = min(bounds[a, 2], trail[k, a, 1])
                bounds[a, 3] = max(bounds[a, 3], trail[k, a, 1])
    best = np.inf
    for b in range(m):
        if np.isnan(trail[newest, b, 0]):
            continue
        x, y, c, s, v = trail[newest, b]
        now = (x, y, c, s, sizes[b, 0], sizes[b, 1], v)
        for a in range(m):
            reach = 0.5 * (sizes[a, 0] + sizes[a, 1] + sizes[b, 0] + sizes[b, 1])
            if a == b or not (relevant[a] or relevant[b]):
                continue
            if x < bounds[a, 0] - reach or x > bounds[a, 1] + reach:
                continue
            if y < bounds[a, 2] - reach or y > bounds[a, 3] + reach:
                continue
            for age in range(1, frames):
                k = (newest - age) % frames
                if np.isnan(trail[k, a, 0]) or trail[k, a, 2] * c + trail[k, a, 3] * s > FOLLOWING_COSINE:
                    continue
                xa, ya, ca, sa, va = trail[k, a]
                then = (xa, ya, ca, sa, sizes[a, 0], sizes[a, 1], va)
                if not _overlap(then, now):
                    continue
                _, leave = _contact(then, now, -va * ca, -va * sa)  # when a has left where b is now
                before = (newest - 1) % frames
                entry = interval  # when, since the frame before, b reached where a was
                if not np.isnan(trail[before, b, 0]):
                    xb, yb, cb, sb, vb = trail[before, b]
                    came = (xb, yb, cb, sb, sizes[b, 0], sizes[b, 1], vb)
                    first, last = _contact(then, came, vb * cb, vb * sb)
                    if first < last:
                        entry = min(max(first, 0.0), interval)
                lag = (age - 1) * interval + entry - min(max(leave, 0.0), interval)
                best = min(best, max(lag, 0.0))
                break
    return best
