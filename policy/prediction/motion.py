"""Rollouts of vehicles along real centre lines at predicted speeds (numba kernels).

A vehicle's front follows one path (a polyline) at a given speed profile. Its lateral offset from that path
closes at a given rate (a lane change, or the rest of one), and its rear trails behind, as in SUMO: the front
changes lanes in 2 s at any speed, the box straightens only over the distance driven. Measured with SUMO 1.28:
after a lane change at 1 m/s a car is 29 degrees askew, at 15 m/s never more than 6.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.road import LanePath
from cosim.types import HEADING, LENGTH, Floats, Ints, X, Y


class Paths(NamedTuple):
    """Concatenated polylines for the kernels."""

    points: Floats  # [p,2] m
    arc: Floats  # [p] m
    start: Ints  # [k+1] first point of each path


class Rollout(NamedTuple):
    """Trajectories; frame 0 is now."""

    x: Floats  # [k,T+1] m
    y: Floats  # [k,T+1] m
    heading: Floats  # [k,T+1] rad
    speed: Floats  # [k,T+1] m/s
    arc: Floats  # [k,T+1] m, front bumper along the path
    rear: Floats  # [k,T+1] m, lateral offset of the rear from the path, left positive


def pack(paths: Sequence[LanePath]) -> Paths:
    """Put paths into one array."""
    start = np.zeros(len(paths) + 1, np.int64)
    np.cumsum([len(p.arc) for p in paths], out=start[1:])
    if not paths:
        return Paths(np.zeros((0, 2)), np.zeros(0), start)
    return Paths(np.concatenate([p.points for p in paths]), np.concatenate([p.arc for p in paths]), start)


@compiled
def project(
    points: Floats, arc: Floats, first: int, last: int, x: float, y: float, around: float
) -> tuple[float, float]:
    """The nearest point on a polyline, which continues straight beyond its ends.

    Args:
        points: [p,2] m; arc: [p] m.
        first, last: the polyline is points[first:last].
        x, y: m, the point.
        around: m, arc length; the search covers 60 m around it; nan: the whole polyline.

    Returns:
        arc length m, offset m (left positive).
    """
    best, best_arc, best_offset = np.inf, 0.0, 0.0
    for i in range(first, last - 1):
        if arc[i + 1] < around - 60.0 or arc[i] > around + 60.0:
            continue
        dx, dy = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
        span2 = dx * dx + dy * dy
        px, py = x - points[i, 0], y - points[i, 1]
        t = (px * dx + py * dy) / span2
        low = -1e9 if i == first else 0.0
        high = 1e9 if i == last - 2 else 1.0
        t = min(max(t, low), high)
        ex, ey = px - t * dx, py - t * dy
        d2 = ex * ex + ey * ey
        if d2 < best:
            best = d2
            span = np.sqrt(span2)
            best_arc = arc[i] + t * span
            cross = dx * py - dy * px
            best_offset = np.sqrt(d2) if cross > 0.0 else -np.sqrt(d2)
    return best_arc, best_offset


@compiled
def project_many(
    points: Floats, arc: Floats, start: Ints, x: Floats, y: Floats, around: Floats
) -> tuple[Floats, Floats]:
    """`project` of one point onto each path.

    Args:
        points, arc, start: k packed paths (`Paths`).
        x, y: [k] m, the point of each path.
        around: [k] m, arc length of the search, as in `project`.

    Returns:
        arc [k] m, offset [k] m (left positive).
    """
    n = x.shape[0]
    out_arc, out_offset = np.empty(n), np.empty(n)
    for k in range(n):
        out_arc[k], out_offset[k] = project(points, arc, start[k], start[k + 1], x[k], y[k], around[k])
    return out_arc, out_offset


@compiled
def project_each(
    points: Floats, arc: Floats, start: Ints, same: Ints, x: Floats, y: Floats
) -> tuple[Floats, Floats]:
    """`project` of every point onto each of the first k paths.

    Args:
        points, arc, start: packed paths (`Paths`).
        same: [k] index of the first identical path, whose result is copied.
        x, y: [n] m.

    Returns:
        arc [k,n] m, offset [k,n] m (left positive).
    """
    count, n = same.shape[0], x.shape[0]
    out_arc, out_offset = np.empty((count, n)), np.empty((count, n))
    for k in range(count):
        if same[k] < k:
            out_arc[k], out_offset[k] = out_arc[same[k]], out_offset[same[k]]
            continue
        for i in range(n):
            out_arc[k, i], out_offset[k, i] = project(points, arc, start[k], start[k + 1], x[i], y[i], np.nan)
    return out_arc, out_offset


@compiled
def _at(points: Floats, arc: Floats, first: int, last: int, i: int, s: float) -> tuple[int, float, float]:
    """Segment, x, y at arc length s, searched from segment i in both directions; straight beyond the ends."""
    while i < last - 2 and arc[i + 1] < s:
        i += 1
    while i > first and arc[i] > s:
        i -= 1
    t = (s - arc[i]) / (arc[i + 1] - arc[i])
    x = points[i, 0] + t * (points[i + 1, 0] - points[i, 0])
    y = points[i, 1] + t * (points[i + 1, 1] - points[i, 1])
    return i, x, y


@compiled
def roll(
    points: Floats,
    arc: Floats,
    start: Ints,
    begin: Floats,
    offset: Floats,
    aim: Floats,
    heading: Floats,
    rate: Floats,
    length: Floats,
    speed: Floats,
    stop: Floats,
    brake: float,
    dt: float,
) -> Floats:
    """Vehicle k along path k.

    Args:
        points, arc, start: k packed paths (`Paths`).
        begin: [k] m, present arc of the front.
        offset: [k] m, present lateral offset of the front from the path, left positive.
        aim: [k] m, final offset.
        heading: [k] rad, present.
        rate: [k] m/s >= 0, lateral speed towards `aim`.
        length: [k] m.
        speed: [k,T+1] m/s.
        stop: [k] m, arc at which the front must stop; inf for none.
        brake: m/s2, deceleration before `stop`.
        dt: s between frames.

    Returns:
        [6,k,T+1] the arrays of a `Rollout`.
    """
    count, frames = speed.shape
    out = np.empty((6, count, frames))
    for k in range(count):
        first, last = start[k], start[k + 1]
        s, front, rear = begin[k], start[k], start[k]
        v = speed[k, 0]
        side = 1.0 if offset[k] > aim[k] else -1.0
        left = abs(offset[k] - aim[k])  # m, remaining
        turn = 0.0
        for t in range(frames):
            if t > 0:
                v_next = speed[k, t]
                distance = stop[k] - s
                if distance < 200.0:
                    v_next = min(v_next, np.sqrt(max(2.0 * brake * distance, 0.0)))
                s = min(s + 0.5 * dt * (v + v_next), max(stop[k], s))
                v = v_next
                drift = min(rate[k], left / dt)
                left -= drift * dt
                # the rear trails: turn' = (drift - v turn) / length, solved over one frame
                drift *= -side
                if v > 0.1:
                    straight = np.exp(-v * dt / length[k])
                    turn = drift / v + (turn - drift / v) * straight
                else:
                    turn += drift * dt / length[k]
                turn = min(max(turn, -0.8), 0.8)
            front, fx, fy = _at(points, arc, first, last, front, s)
            rear, rx, ry = _at(points, arc, first, last, rear, s - length[k])
            along = np.arctan2(fy - ry, fx - rx)  # SUMO's angle on a bend: from rear to front
            if t == 0:
                turn = (heading[k] - along + np.pi) % (2.0 * np.pi) - np.pi
                turn = min(max(turn, -0.8), 0.8)
            h = along + turn
            beside = aim[k] + side * left
            fx -= np.sin(along) * beside
            fy += np.cos(along) * beside
            out[0, k, t] = fx - 0.5 * length[k] * np.cos(h)
            out[1, k, t] = fy - 0.5 * length[k] * np.sin(h)
            out[2, k, t], out[3, k, t], out[4, k, t] = h, v, s
            out[5, k, t] = beside - length[k] * np.sin(turn)
    return out


@compiled
def roll_one(
    points: Floats,
    arc: Floats,
    start: Ints,
    now: Floats,
    around: float,
    speed: Floats,
    beside: float,
    change: float,
    settle: float,
    brake: float,
    dt: float,
) -> Floats:
    """One vehicle on each of k paths.

    An offset of more than `beside` m from the path closes with `change` m/s (a lane change, new or under
    way), a smaller one with `settle`.

    Args:
        points, arc, start: k packed paths (`Paths`).
        now: [8] KINEMATIC_FEATURES in the world (m, m/s, rad).
        around: m, approximate arc of its front along every path.
        speed: [k,T+1] m/s.
        beside: m.
        change, settle: m/s.
        brake: m/s2 before a stop (unused: there is no stop).
        dt: s between frames.

    Returns:
        [6,k,T+1] the arrays of a `Rollout`.
    """
    count = speed.shape[0]
    begin, offset, rate = np.empty(count), np.empty(count), np.empty(count)
    half = 0.5 * now[4]
    x, y = now[0] + half * np.cos(now[3]), now[1] + half * np.sin(now[3])
    for k in range(count):
        begin[k], offset[k] = project(points, arc, start[k], start[k + 1], x, y, around)
        rate[k] = change if abs(offset[k]) > beside else settle
    still = np.zeros(count)
    heading, length, stop = still + now[3], still + now[4], still + np.inf
    return roll(points, arc, start, begin, offset, still, heading, rate, length, speed, stop, brake, dt)


def fronts(state: Floats) -> tuple[Floats, Floats]:
    """Front bumper x [k] m, y [k] m of vehicles [k,8] (KINEMATIC_FEATURES in the world)."""
    half = 0.5 * state[:, LENGTH]
    return state[:, X] + half * np.cos(state[:, HEADING]), state[:, Y] + half * np.sin(state[:, HEADING])
