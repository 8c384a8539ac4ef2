"""The kinematic matrix: the choice of rows, and the rows of every past frame in one fixed ego frame."""

import numpy as np
import numpy.typing as npt

from cosim.geometry import gap_ahead
from cosim.geometry.compiled import compiled
from cosim.road import LaneGraph
from cosim.types import HEADING, SPEED, Bools, Floats, Floats32, Ints, Snapshot, X, Y


def perceived(snapshot: Snapshot, egos: Ints, reach: float, share: bool) -> Bools:
    """The vehicles perceived by each AV: [B,n].

    Args:
        snapshot: the n vehicles on the road.
        egos: [B] rows of the AVs.
        reach: m, range of an AV's own sensors, between centres.
        share: whether AVs share their perception (V2V): then all perceive the same vehicles.
    """
    x, y = snapshot.x, snapshot.y
    near = (x - x[egos, None]) ** 2 + (y - y[egos, None]) ** 2 <= reach * reach
    return near | near.any(0) if share else near


@compiled
def choose_rows(
    x: Floats,  # [n] m
    y: Floats,  # [n] m
    egos: npt.NDArray[np.int64],  # [B]
    seen: Bools,  # [B,n]
    row_range: float,  # m
    first: Bools,  # [B,n] vehicles that get a row before all others
    rows: npt.NDArray[np.int64],  # [B,R] out: vehicle of each row, -1 for none; row 0 the ego
) -> bool:
    """The ego and the perceived vehicles within `row_range`, by distance; whether a vehicle got no row."""
    n, wanted = x.shape[0], rows.shape[1]
    rank = np.empty(wanted, np.float64)  # squared distance, minus a large offset for `first`
    full = False
    for b in range(egos.shape[0]):
        e = egos[b]
        rows[b] = -1
        rows[b, 0] = e
        count = 1
        for j in range(n):
            if j == e or not seen[b, j]:
                continue
            d2 = (x[j] - x[e]) ** 2 + (y[j] - y[e]) ** 2
            if d2 > row_range * row_range:
                continue
            if first[b, j]:
                d2 -= 1e9
            full = full or count == wanted
            if count == wanted and d2 >= rank[count - 1]:
                continue
            k = count if count < wanted else wanted - 1
            while k > 1 and rank[k - 1] > d2:
                rank[k] = rank[k - 1]
                rows[b, k] = rows[b, k - 1]
                k -= 1
            rank[k] = d2
            rows[b, k] = j
            count = min(count + 1, wanted)
        for k in range(2, count):  # vehicles of `first` are sorted by distance too
            j, d2 = rows[b, k], rank[k] + (1e9 if first[b, rows[b, k]] else 0.0)
            i = k
            while i > 1 and rank[i - 1] + (1e9 if first[b, rows[b, i - 1]] else 0.0) > d2:
                rank[i] = rank[i - 1]
                rows[b, i] = rows[b, i - 1]
                i -= 1
            rank[i] = d2 - (1e9 if first[b, j] else 0.0)
            rows[b, i] = j
    return full


def never_left_out(snapshot: Snapshot, graph: LaneGraph, egos: Ints, reach: float) -> Bools:
    """The vehicles with a guaranteed row: mission vehicles, and each ego's leader and follower.

    Args:
        snapshot: the n vehicles.
        graph: successor lanes (`RoadMap.straight_on`).
        egos: [B] rows of the AVs.
        reach: m, search range ahead and behind along the lanes.

    Returns:
        [B,n] whether vehicle n is one of ego B's.
    """
    first = np.repeat(snapshot.mission[None], len(egos), 0)
    gap, leader = gap_ahead(snapshot, graph, np.arange(snapshot.n), reach)
    for b, ego in enumerate(egos):
        if leader[ego] >= 0:
            first[b, leader[ego]] = True
        behind = np.flatnonzero(leader == ego)
        if len(behind):
            first[b, behind[np.argmin(gap[behind])]] = True
    return first


@compiled
def fill_rows(
    past: Floats,  # [N,S,4] x m, y m, speed m/s, unwrapped heading rad per slot; nan where absent
    slots: npt.NDArray[np.int64],  # [n] slot of each present vehicle
    rows: npt.NDArray[np.int64],  # [B,R]
    fixed: Floats,  # [n,4] length m, width m, is_av, is_mission
    kinematics: Floats32,  # [B,N,R,8] out, KINEMATIC_FEATURES; given as zeros
    valid: Bools,  # [B,N,R] out; given as False
) -> None:
    """Every past frame of every row, in the ego's frame at the newest frame."""
    frames = past.shape[0]
    for b in range(rows.shape[0]):
        ego = slots[rows[b, 0]]
        x0, y0, h0 = past[frames - 1, ego, X], past[frames - 1, ego, Y], past[frames - 1, ego, HEADING]
        c, s = np.cos(h0), np.sin(h0)
        for r in range(rows.shape[1]):
            j = rows[b, r]
            if j < 0:
                continue
            slot = slots[j]
            turn = past[frames - 1, slot, HEADING] - h0
            base = (turn + np.pi) % (2 * np.pi) - np.pi - turn - h0  # newest heading in (-pi, pi]
            for k in range(frames):
                if np.isnan(past[k, slot, X]):
                    continue
                valid[b, k, r] = True
                dx, dy = past[k, slot, X] - x0, past[k, slot, Y] - y0
                kinematics[b, k, r, X] = c * dx + s * dy
                kinematics[b, k, r, Y] = c * dy - s * dx
                kinematics[b, k, r, SPEED] = past[k, slot, SPEED]
                kinematics[b, k, r, HEADING] = past[k, slot, HEADING] + base
                for f in range(4):
                    kinematics[b, k, r, 4 + f] = fixed[j, f]
