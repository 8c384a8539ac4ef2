"""The compiled kernels behind `cosim.geometry`: boxes as tuples, one pair at a time.

A box is the tuple (x, y, cos heading, sin heading, length, width, speed): m, m, -, -, m, m, m/s.
All in one file on purpose: numba's cache on disk notices a change of the file a kernel stands in, not of
the files it calls into.
"""

import functools
from collections.abc import Callable
from typing import Any, cast

import numba
import numpy as np
import numpy.typing as npt

from cosim.geometry.compiled import cached, compiled
from cosim.types import Bools, Floats, Ints

FOLLOWING_COSINE = float(np.cos(np.radians(15.0)))  # headings closer than 15 degrees: following, not crossing
_STRAIGHT_COSINE = float(np.cos(np.radians(5.0)))  # a trail that stays within 5 degrees is straight
_SAME_COURSE_COSINE = float(np.cos(np.radians(10.0)))  # 10 + 5 degrees: every spot of it is following
_ONCOMING_COSINE = -float(np.cos(np.radians(45.0)))  # headings more than 135 degrees apart: head-on
_PARALLEL = 1e-12  # m/s or cosine below which a projection counts as standing still
_HORIZON = 120.0  # s, how far ahead the deceleration to avoid a crash is sought

Box = tuple[float, float, float, float, float, float, float]
_numba = cast(Any, numba)  # its decorators are not typed


def _ufunc(inputs: int, result: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A broadcasting numpy ufunc of `inputs` float64 arguments, compiled by numba when first called."""
    signature = f"{result}({', '.join(['float64'] * inputs)})"

    def compile_later(function: Callable[..., Any]) -> Callable[..., Any]:
        vectorize = cached(functools.partial(_numba.vectorize, [signature]))
        made = functools.cache(lambda: vectorize(function))
        return lambda *arguments: made()(*arguments)

    return compile_later


@compiled
def _slab(p: float, w: float, r: float) -> tuple[float, float]:
    """When |p + w t| < r: (entry, exit) in s, for a projected distance p m that changes by w m/s."""
    if abs(w) < _PARALLEL:
        if abs(p) < r:
            return -np.inf, np.inf
        return np.inf, -np.inf
    first = (-r - p) / w
    second = (r - p) / w
    return min(first, second), max(first, second)


@compiled
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


@compiled
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


@compiled
def _ttc(a: Box, b: Box, cap: float) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    vx, vy = b[6] * b[2] - a[6] * a[2], b[6] * b[3] - a[6] * a[3]
    reach = 0.5 * (a[4] + a[5] + b[4] + b[5])  # at least the sum of the half diagonals
    apart, drift = dx * dx + dy * dy, vx * vx + vy * vy
    if dx * vx + dy * vy >= 0.0 and apart >= reach * reach:
        return cap  # drawing away from each other
    if cap < _HORIZON and apart > 2.0 * (reach * reach + cap * cap * drift):  # 2 (r^2 + q^2) >= (r + q)^2
        return cap  # too far to touch within `cap`
    miss = dx * vy - dy * vx
    if miss * miss >= reach * reach * drift and drift > 0.0:
        return cap  # the centres' closest approach is too far
    entry, leave = _contact(a, b, vx, vy)
    if entry >= leave or leave <= 0.0:
        return cap
    return min(max(entry, 0.0), cap)


@compiled
def _needed(t: float, distance: float, v: float) -> float:
    """Deceleration (m/s2) with which a car at v m/s has driven at most `distance` m at time t s."""
    if distance >= v * t:
        return 0.0
    if 2.0 * distance >= v * t:
        return 2.0 * (v * t - distance) / (t * t)
    return v * v / (2.0 * distance) if distance > 0.0 else np.inf  # it must stop before t


@compiled
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
    t0, t1 = 0.0, 10.0 * _HORIZON  # braking lasts twice the time to collision at most
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
                distance = low[0] + slope[0] * t
                for k in range(1, lines):
                    distance = max(distance, low[k] + slope[k] * t)
                worst = max(worst, _needed(t, distance, v))
    return worst


@compiled
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
def overlap_ufunc(
    ax: float, ay: float, ac: float, as_: float, al: float, aw: float,
    bx: float, by: float, bc: float, bs: float, bl: float, bw: float,
) -> bool:
    return _overlap((ax, ay, ac, as_, al, aw, 0.0), (bx, by, bc, bs, bl, bw, 0.0))


@_ufunc(15, "float64")
def ttc_ufunc(
    ax: float, ay: float, ac: float, as_: float, al: float, aw: float, av: float,
    bx: float, by: float, bc: float, bs: float, bl: float, bw: float, bv: float, cap: float,
) -> float:
    return _ttc((ax, ay, ac, as_, al, aw, av), (bx, by, bc, bs, bl, bw, bv), cap)


@_ufunc(14, "float64")
def drac_ufunc(
    ax: float, ay: float, ac: float, as_: float, al: float, aw: float, av: float,
    bx: float, by: float, bc: float, bs: float, bl: float, bw: float, bv: float,
) -> float:
    return _drac((ax, ay, ac, as_, al, aw, av), (bx, by, bc, bs, bl, bw, bv))


# fmt: on


@compiled
def _box(table: Floats, i: int) -> Box:
    """Row i of a table of boxes [n,7]."""
    return table[i, 0], table[i, 1], table[i, 2], table[i, 3], table[i, 4], table[i, 5], table[i, 6]


# fmt: off
@compiled
def first_contacts(
    ax: Floats, ay: Floats, ac: Floats, as_: Floats, av: Floats, al: float, aw: float,
    bx: Floats, by: Floats, bc: Floats, bs: Floats, bv: Floats, bl: Floats, bw: Floats, dt: float,
) -> Floats:
    # fmt: on
    """See `cosim.geometry.first_contacts`."""
    count, frames = ax.shape
    out = np.full((count, bx.shape[0]), np.inf)
    for k in range(count):
        for o in range(bx.shape[0]):
            for t in range(frames):
                a = (ax[k, t], ay[k, t], ac[k, t], as_[k, t], al, aw, av[k, t])
                b = (bx[o, t], by[o, t], bc[o, t], bs[o, t], bl[o], bw[o], bv[o, t])
                ttc = _ttc(a, b, dt)
                if ttc < dt:
                    out[k, o] = dt * t + ttc
                    break
    return out


@compiled
def _table_of(pairs: list[tuple[int, int]]) -> Ints:
    table = np.empty((len(pairs), 2), np.int64)
    for k in range(len(pairs)):
        table[k, 0], table[k, 1] = pairs[k]
    return table


@compiled
def conflicts(
    x: Floats,
    y: Floats,
    heading: Floats,
    length: Floats,
    width: Floats,
    speed: Floats,
    watched: Bools,
    horizon: float,
    number: Ints,
    touch: Bools,
    soon: float,
    hard: float,
) -> tuple[Ints, Floats, Floats, Ints, Ints]:
    """See `cosim.geometry.conflicts`."""
    n = len(x)
    cosine, sine = np.cos(heading), np.sin(heading)
    nearest, hardest = np.full(n, horizon), np.zeros(n)
    near, braking = [(0, 0) for _ in range(0)], [(0, 0) for _ in range(0)]
    fastest, largest = 0.0, 0.0  # m/s, m
    for i in range(n):
        fastest, largest = max(fastest, abs(speed[i])), max(largest, length[i] + width[i])
    reach = largest + 2.0 * fastest * horizon  # m, nobody further away can be met
    order = np.argsort(x)
    for k in range(n):
        for other in order[k + 1 :]:
            i, j = min(order[k], other), max(order[k], other)
            if x[other] - x[order[k]] > reach:
                break
            if not touch[number[i], number[j]]:
                continue
            if watched[j] and not watched[i]:
                i, j = j, i
            a = (x[i], y[i], cosine[i], sine[i], length[i], width[i], speed[i])
            b = (x[j], y[j], cosine[j], sine[j], length[j], width[j], speed[j])
            ttc = _ttc(a, b, horizon)
            if not 0.0 < ttc < horizon:
                if ttc <= 0.0:
                    nearest[i] = nearest[j] = 0.0
                continue
            needed = _drac(a, b)
            needed = needed if needed < np.inf else 0.0
            nearest[i], hardest[i] = min(nearest[i], ttc), max(hardest[i], needed)
            nearest[j], hardest[j] = min(nearest[j], ttc), max(hardest[j], needed)
            if ttc < soon:
                near.append((min(i, j), max(i, j)))
            if needed > hard:
                braking.append((min(i, j), max(i, j)))
    rows = np.flatnonzero(watched)
    return rows, nearest[rows], hardest[rows], _table_of(near), _table_of(braking)


@compiled
def _cells(x: Floats, y: Floats, rows: Ints, side: float) -> tuple[Ints, Ints, Floats, Ints]:
    """Sort places into the cells of a square grid.

    Args:
        x, y: m.
        rows: [k] which of them.
        side: m, of a cell at least; there are never more than a few cells per place.

    Returns:
        the rows by cell [k], in a cell in their order; where each cell's begin in it [cells + 1];
        the grid's (west m, south m, side m); its (columns, lines).
    """
    west, east, south, north = np.inf, -np.inf, np.inf, -np.inf
    for i in rows:
        west, east, south, north = min(west, x[i]), max(east, x[i]), min(south, y[i]), max(north, y[i])
    if not east - west + north - south < np.inf:  # nobody is there, or somewhere unknown: one cell
        west, south, side = 0.0, 0.0, np.inf
        columns, lines = 1, 1
    else:
        most = 2.0 * np.sqrt(len(rows)) + 1.0
        side = max(side, (east - west) / most, (north - south) / most)
        columns, lines = int((east - west) / side) + 1, int((north - south) / side) + 1
    begin = np.zeros(columns * lines + 1, np.int64)
    cell = np.empty(len(rows), np.int64)
    for k in range(len(rows)):
        column, line = _cell(x[rows[k]] - west, side, columns), _cell(y[rows[k]] - south, side, lines)
        cell[k] = line * columns + column
        begin[cell[k] + 1] += 1
    for k in range(1, len(begin)):
        begin[k] += begin[k - 1]
    order, next_ = np.empty(len(rows), np.int64), begin.copy()
    for k in range(len(rows)):
        order[next_[cell[k]]] = rows[k]
        next_[cell[k]] += 1
    return order, begin, np.array([west, south, side]), np.array([columns, lines])


@compiled
def _cell(away: float, side: float, count: int) -> int:
    """The column or line of a grid, so many m from its edge; the nearest one for who is outside."""
    if not away > 0.0 or side == np.inf:
        return 0
    return min(int(min(away / side, 1e9)), count - 1)


@compiled
def pairs_overlap(table: Floats) -> Ints:
    """See `cosim.geometry.overlapping_pairs`."""
    n = len(table)
    out = np.empty((64, 2), dtype=np.int64)
    found = 0
    largest = 0.0  # m, a box's reach from its centre
    for i in range(n):
        largest = max(largest, 0.5 * (table[i, 4] + table[i, 5]))
    order, begin, (west, south, side), (columns, lines) = _cells(
        table[:, 0], table[:, 1], np.arange(n), 2.0 * largest + 1.0
    )
    for i in range(n):
        a = _box(table, i)
        reach, first = largest + 0.5 * (a[4] + a[5]), found
        left, right = _cell(a[0] - reach - west, side, columns), _cell(a[0] + reach - west, side, columns)
        low, high = _cell(a[1] - reach - south, side, lines), _cell(a[1] + reach - south, side, lines)
        for line in range(low, high + 1):
            for j in order[begin[line * columns + left] : begin[line * columns + right + 1]]:
                if j > i and _overlap(a, _box(table, j)):
                    if found == len(out):
                        out = np.concatenate((out, np.empty_like(out)))
                    k = found
                    while k > first and out[k - 1, 1] > j:
                        out[k, 1] = out[k - 1, 1]
                        k -= 1
                    out[found, 0], out[k, 1] = i, j
                    found += 1
    return out[:found].copy()


@compiled
def lane_gaps(
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
    first = np.full(len(following), -1, np.int64)  # on each lane its first row, and behind each row the next
    behind = np.full(len(lane), -1, np.int64)
    for j in range(len(lane) - 1, -1, -1):
        if lane[j] >= 0:
            behind[j], first[lane[j]] = first[lane[j]], j
    for k in range(len(rows)):
        i = rows[k]
        if lane[i] < 0:
            continue
        here = int(lane[i])
        travelled = -position[i]  # m from the front bumper to the start of `here`
        while here >= 0 and travelled <= reach and leaders[k] < 0:
            j = first[here]
            while j >= 0:
                ahead = travelled + position[j]
                if j != i and ahead > 0.0 and ahead - length[j] < min(gaps[k], reach):
                    gaps[k] = ahead - length[j]
                    leaders[k] = j
                j = behind[j]
            travelled += lane_length[here]
            here = following[here]
    return gaps, leaders


@compiled
def _trail_bounds(trail: Floats, newest: int, m: int) -> tuple[Floats, Floats]:
    """Each trail without its newest frame: x and y bounds [m,4] m; direction if straight, else 0 [m,2]."""
    bounds, course = np.empty((m, 4)), np.zeros((m, 2))
    for a in range(m):
        x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
        c, s, straight = 0.0, 0.0, True
        for age in range(1, trail.shape[0]):
            k = newest - age
            x, y = trail[k, a, 0], trail[k, a, 1]  # a negative k counts from the ring's end
            if not np.isnan(x):
                x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
                if c == 0.0 and s == 0.0:
                    c, s = trail[k, a, 2], trail[k, a, 3]
                straight = straight and c * trail[k, a, 2] + s * trail[k, a, 3] > _STRAIGHT_COSINE
        bounds[a, 0], bounds[a, 1], bounds[a, 2], bounds[a, 3] = x0, x1, y0, y1
        if straight:
            course[a, 0], course[a, 1] = c, s
    return bounds, course


@compiled
def record(
    trail: Floats,
    newest: int,
    slot: Ints,
    x: Floats,
    y: Floats,
    heading: Floats,
    speed: Floats,
    number: Ints,
) -> None:
    """Write a frame of vehicles (places `slot` [n]) into a ring of frames, see `encroachment`."""
    trail[newest] = np.nan
    for k in range(len(slot)):
        row = trail[newest, slot[k]]
        row[0], row[1], row[2], row[3], row[4] = x[k], y[k], np.cos(heading[k]), np.sin(heading[k]), speed[k]
        row[5] = number[k]


@compiled
def _lag(
    trail: Floats, newest: int, a: int, b: int, sizes: Floats, interval: float, touch: Bools, back: int
) -> float:
    """Post-encroachment time (s, inf for none) of b, now, after a up to `back` frames ago, as in
    `encroachment`."""
    frames = trail.shape[0]
    x, y, c, s, v, road = trail[newest, b]
    now = (x, y, c, s, sizes[b, 0], sizes[b, 1], v)
    for age in range(1, min(back + 1, frames)):
        k = (newest - age) % frames
        if np.isnan(trail[k, a, 0]) or trail[k, a, 2] * c + trail[k, a, 3] * s > FOLLOWING_COSINE:
            continue
        xa, ya, ca, sa, va, other = trail[k, a]
        then = (xa, ya, ca, sa, sizes[a, 0], sizes[a, 1], va)
        if not _overlap(then, now) or not touch[int(road), int(other)]:
            continue
        _, leave = _contact(then, now, -va * ca, -va * sa)  # when a has left where b is now
        before = (newest - 1) % frames
        entry = interval  # when, since the frame before, b reached where a was
        if not np.isnan(trail[before, b, 0]):
            xb, yb, cb, sb, vb, _ = trail[before, b]
            came = (xb, yb, cb, sb, sizes[b, 0], sizes[b, 1], vb)
            first, last = _contact(then, came, vb * cb, vb * sb)
            if first < last:
                entry = min(max(first, 0.0), interval)
        lag = (age - 1) * interval + entry - min(max(leave, 0.0), interval)
        return max(lag, 0.0)
    return np.inf


@compiled
def encroachment(
    trail: Floats,
    newest: int,
    m: int,
    sizes: Floats,
    relevant: Bools,
    interval: float,
    touch: Bools,
    soon: float = 0.0,
) -> tuple[float, Ints]:
    """Smallest post-encroachment time (s, inf for none) that ends at the newest frame of a ring of frames,
    and [p,2] every pair, relevant or not, the one who came first first, whose own is below `soon` s.

    trail [K,>=m,6] of the first m vehicles (x m, y m, cos heading, sin heading, speed m/s, number of the
    road; NaN while absent), `newest` its newest frame, the frame after it (cyclically) the oldest; sizes
    [>=m,2] length and width in m; the smallest is over pairs with a `relevant` [>=m] vehicle; pairs whose
    roads do not `touch` [S,S] have none; `interval` s between frames. See `post_encroachment_time`.
    """
    bounds, course = _trail_bounds(trail, newest, m)
    present = np.flatnonzero(~np.isnan(trail[newest, :m, 0]))
    order, begin, (west, south, side), (columns, lines) = _cells(
        trail[newest, :, 0], trail[newest, :, 1], present, 20.0
    )
    largest = 0.0  # m, a box's reach from its centre
    for a in range(m):
        largest = max(largest, 0.5 * (sizes[a, 0] + sizes[a, 1]))
    best, near = np.inf, [(0, 0) for _ in range(0)]
    recent = int(np.ceil(soon / interval)) + 1
    for a in range(m):
        if not bounds[a, 0] <= bounds[a, 1]:
            continue  # it was not there before
        margin = 0.5 * (sizes[a, 0] + sizes[a, 1]) + largest + 1.0  # m, more than any reach below
        left = _cell(bounds[a, 0] - margin - west, side, columns)
        right = _cell(bounds[a, 1] + margin - west, side, columns)
        low = _cell(bounds[a, 2] - margin - south, side, lines)
        high = _cell(bounds[a, 3] + margin - south, side, lines)
        for line in range(low, high + 1):
            for b in order[begin[line * columns + left] : begin[line * columns + right + 1]]:
                counts = relevant[a] or relevant[b]
                if a == b or not (counts or soon > 0.0):
                    continue
                x, y, c, s = trail[newest, b, :4]
                if course[a, 0] * c + course[a, 1] * s > _SAME_COURSE_COSINE:
                    continue
                reach = 0.5 * (sizes[a, 0] + sizes[a, 1] + sizes[b, 0] + sizes[b, 1])
                beside = x < bounds[a, 0] - reach or x > bounds[a, 1] + reach
                if beside or y < bounds[a, 2] - reach or y > bounds[a, 3] + reach:
                    continue
                lag = _lag(
                    trail, newest, a, b, sizes, interval, touch, trail.shape[0] if counts else recent
                )
                if counts:
                    best = min(best, lag)
                if lag < soon:
                    near.append((a, b))
    return best, _table_of(near)
