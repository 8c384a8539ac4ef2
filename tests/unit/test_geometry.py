"""Driving sentences about boxes: what touches, when, how hard one must brake, and who passed how closely."""

from __future__ import annotations

import time
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cosim.geometry import (
    EVERYWHERE,
    Boxes,
    compiled,
    conflicts,
    deceleration_to_avoid_crash,
    gap_ahead,
    headway,
    kernels,
    overlap,
    overlapping_pairs,
    post_encroachment_time,
    time_to_collision,
)
from cosim.road import Lane, RoadMap
from cosim.types import Floats, Snapshot

metres = st.floats(-60.0, 60.0)
angles = st.floats(-np.pi, np.pi)
box = st.builds(
    Boxes, metres, metres, angles, st.floats(1.0, 12.0), st.floats(0.5, 3.0), st.floats(0.0, 40.0)
)
many = settings(max_examples=80, deadline=None)  # the first call may compile


def car(
    x: float, y: float, heading_deg: float, speed: float, length: float = 5.0, width: float = 2.0
) -> Boxes:
    return Boxes(x, y, float(np.radians(heading_deg)), length, width, speed)


def moved(b: Boxes, seconds: float | Floats) -> Boxes:
    return b._replace(
        x=b.x + b.speed * np.cos(b.heading) * seconds, y=b.y + b.speed * np.sin(b.heading) * seconds
    )


def transformed(b: Boxes, turn: float, dx: float, dy: float) -> Boxes:
    c, s = np.cos(turn), np.sin(turn)
    return b._replace(x=c * b.x - s * b.y + dx, y=s * b.x + c * b.y + dy, heading=b.heading + turn)


def grown(b: Boxes, by: Any) -> Boxes:
    return b._replace(length=b.length + by, width=b.width + by)


# ---- overlap -------------------------------------------------------------------------------------------


def test_cars_bumper_to_bumper_do_not_overlap_but_ten_centimetres_closer_they_do() -> None:
    behind = car(0, 0, 0, 20)
    assert not overlap(behind, car(5.0, 0, 0, 20))
    assert overlap(behind, car(4.9, 0, 0, 20))


def test_a_turned_box_in_the_corner_of_the_bounding_circle_does_not_overlap() -> None:
    assert not overlap(car(0, 0, 0, 0), car(0.0, 3.6, 45, 0))  # half heights 1 + 2.47
    assert overlap(car(0, 0, 0, 0), car(0.0, 3.4, 45, 0))


@many
@given(a=box, b=box)
def test_overlap_is_exact(a: Boxes, b: Boxes) -> None:
    """A point of one box lies in the other exactly when they overlap (checked on a fine grid)."""
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 61), np.linspace(-0.5, 0.5, 61))
    c, s = np.cos(a.heading), np.sin(a.heading)
    x = a.x + c * u * a.length - s * v * a.width - b.x
    y = a.y + s * u * a.length + c * v * a.width - b.y
    along, across = (
        x * np.cos(b.heading) + y * np.sin(b.heading),
        y * np.cos(b.heading) - x * np.sin(b.heading),
    )
    clear = 1e-6  # m: touching edges are no overlap, and rounding must not make them one
    inside = (np.abs(along) < 0.5 * b.length - clear) & (np.abs(across) < 0.5 * b.width - clear)
    if inside.any():
        assert overlap(a, b)
    elif overlap(a, b):  # then only by less than the grid's mesh
        assert not overlap(grown(a, -2 * a.length / 60), grown(b, -2 * a.length / 60))


@many
@given(a=box, b=box, turn=angles, dx=metres, dy=metres)
def test_overlap_is_symmetric_and_does_not_depend_on_where_we_stand(
    a: Boxes, b: Boxes, turn: float, dx: float, dy: float
) -> None:
    if overlap(grown(a, 1e-6), b) == overlap(grown(a, -1e-6), b):  # not a touch to the last bit
        assert overlap(a, b) == overlap(b, a)
        assert overlap(a, b) == overlap(transformed(a, turn, dx, dy), transformed(b, turn, dx, dy))


def test_overlapping_pairs_finds_the_same_pairs_as_the_matrix() -> None:
    rng = np.random.default_rng(200_000)
    crowd = Boxes(
        rng.uniform(0, 60, 40),
        rng.uniform(0, 20, 40),
        rng.uniform(-3, 3, 40),
        np.full(40, 5.0),
        np.full(40, 2.0),
    )
    matrix = overlap(Boxes(*(np.asarray(v)[..., None] for v in crowd)), crowd)
    expected = np.argwhere(np.triu(matrix, k=1))
    assert len(expected) > 5
    assert np.array_equal(overlapping_pairs(crowd), expected)


# ---- time to collision ---------------------------------------------------------------------------------


@many
@given(gap=st.floats(0.1, 200.0), fast=st.floats(0.0, 40.0), slow=st.floats(0.0, 40.0), turn=angles)
def test_following_in_line_ttc_is_gap_over_closing_speed(
    gap: float, fast: float, slow: float, turn: float
) -> None:
    follower = transformed(Boxes(0.0, 0.0, 0.0, 5.0, 2.0, fast), turn, 3.0, -7.0)
    leader = transformed(Boxes(5.0 + gap, 0.0, 0.0, 5.0, 2.0, slow), turn, 3.0, -7.0)
    ttc = time_to_collision(follower, leader)
    if fast - slow > 1e-3:
        assert ttc == pytest.approx(gap / (fast - slow), rel=1e-6, abs=1e-6)
    elif fast <= slow:
        assert ttc > 1e5  # never, up to rounding of the headings


def test_overtaking_in_the_next_lane_is_no_conflict() -> None:
    assert time_to_collision(car(0, 0, 0, 40), car(30, 3.2, 0, 10)) == np.inf
    assert time_to_collision(car(0, 0, 0, 20), car(60, 3.2, 180, 20)) == np.inf  # oncoming, own lane


def test_a_car_that_cuts_in_is_a_conflict() -> None:
    """Next lane, 2 m/s of lateral speed, 1.2 m between the sides: 0.6 s."""
    speed = float(np.hypot(20.0, 2.0))
    cutting = Boxes(0.0, 3.2, -float(np.arctan2(2.0, 20.0)), 5.0, 2.0, speed)
    ttc = float(time_to_collision(Boxes(0.0, 0.0, 0.0, 5.0, 2.0, 20.0), cutting))
    assert 0.4 < ttc < 0.6  # its turned corner is ahead of its side


def test_crossing_cars_collide_or_clear() -> None:
    """20 m/s both, one 1 s ahead of the other at the crossing: 7 m of passage at 20 m/s leaves 0.65 s."""
    assert time_to_collision(car(-40, 0, 0, 20), car(0, -60, 90, 20)) == np.inf
    assert time_to_collision(car(-40, 0, 0, 20), car(0, -42, 90, 20)) == pytest.approx((42 - 3.5) / 20)


@many
@given(a=box, b=box, turn=angles, dx=metres, dy=metres)
def test_ttc_is_symmetric_and_rigid_motion_invariant(
    a: Boxes, b: Boxes, turn: float, dx: float, dy: float
) -> None:
    ttc = float(time_to_collision(a, b, cap=30.0))
    slack = [float(time_to_collision(grown(a, by), grown(b, by), cap=30.0)) for by in (1e-5, -1e-5)]
    if abs(slack[0] - slack[1]) > 1e-2:  # a graze: rounding decides
        return
    assert float(time_to_collision(b, a, cap=30.0)) == pytest.approx(ttc, abs=1e-2)
    there = time_to_collision(transformed(a, turn, dx, dy), transformed(b, turn, dx, dy), cap=30.0)
    assert float(there) == pytest.approx(ttc, abs=1e-2)


@many
@given(a=box, b=box)
@example(a=Boxes(0.0, 0.0, 0.0, 1.0, 1.0, 1.0), b=Boxes(1.0, 0.0, 0.0, 1.0, 1.0, 0.0))
def test_the_boxes_touch_at_the_predicted_moment_and_not_before(a: Boxes, b: Boxes) -> None:
    ttc = float(time_to_collision(a, b))
    steps = np.linspace(0.0, min(ttc, 20.0), 200)
    path_a, path_b = (moved(Boxes(*(np.full(200, v) for v in c)), steps) for c in (a, b))
    if ttc == 0.0:  # or touches already, and comes nearer
        assert overlap(grown(a, 1e-6), grown(b, 1e-6))
        return
    shrunk = overlap(grown(path_a, -1e-6), grown(path_b, -1e-6))
    assert not shrunk[:-1].any()
    if ttc < 20.0:
        assert overlap(grown(moved(a, ttc), 1e-6), grown(moved(b, ttc), 1e-6))


# ---- deceleration to avoid a crash ---------------------------------------------------------------------


@many
@given(gap=st.floats(1.0, 100.0), fast=st.floats(5.0, 40.0), share=st.floats(0.0, 0.7))
def test_drac_of_a_follower_is_closing_speed_squared_over_twice_the_gap(
    gap: float, fast: float, share: float
) -> None:
    slow = fast * share
    drac = deceleration_to_avoid_crash(car(0, 0, 0, fast), car(5.0 + gap, 0, 0, slow))
    assert float(drac) == pytest.approx((fast - slow) ** 2 / (2.0 * gap), rel=1e-6)


def test_drac_is_zero_when_opening_and_infinite_when_overlapping() -> None:
    assert deceleration_to_avoid_crash(car(0, 0, 0, 10), car(25, 0, 0, 20)) == 0.0
    assert deceleration_to_avoid_crash(car(0, 0, 0, 30), car(25, 3.2, 0, 10)) == 0.0
    assert deceleration_to_avoid_crash(car(0, 0, 0, 10), car(3, 0, 0, 20)) == np.inf


def test_head_on_cars_at_equal_speed_each_stop_in_half_the_gap() -> None:
    drac = float(deceleration_to_avoid_crash(car(0, 0, 0, 15), car(55, 0, 180, 15)))
    assert drac == pytest.approx(15.0**2 / (2.0 * 25.0))


def collides_when_braking(braking: Boxes, other: Boxes, deceleration: float) -> bool:
    t = np.linspace(0.0, 20.0, 40_001)  # s, fine enough for a grazing corner
    stop = braking.speed / max(deceleration, 1e-9)
    s = np.where(t < stop, braking.speed * t - 0.5 * deceleration * t**2, 0.5 * braking.speed * stop)
    path = braking._replace(
        x=braking.x + s * np.cos(braking.heading), y=braking.y + s * np.sin(braking.heading)
    )
    return bool(overlap(path, moved(other, t)).any())


@many
@given(
    distance=st.floats(15.0, 60.0),
    lead=st.floats(-0.4, 0.4),
    va=st.floats(4.0, 20.0),
    vb=st.floats(4.0, 20.0),
    angle=st.floats(30.0, 120.0),
)
def test_at_a_crossing_braking_with_the_drac_just_avoids_the_crash(
    distance: float, lead: float, va: float, vb: float, angle: float
) -> None:
    """One car brakes with 1.02 of the DRAC: no overlap; neither can do with 0.9 of it."""
    a = car(-distance, 0, 0, va)
    reach = vb * (distance / va + lead)
    b = car(-reach * np.cos(np.radians(angle)), -reach * np.sin(np.radians(angle)), angle, vb)
    if not 0.3 < time_to_collision(a, b) < 10.0:
        return
    drac = float(deceleration_to_avoid_crash(a, b))
    assert np.isfinite(drac)
    assert not (collides_when_braking(a, b, 1.02 * drac) and collides_when_braking(b, a, 1.02 * drac))
    if drac > 0.1:
        assert collides_when_braking(a, b, 0.9 * drac)
        assert collides_when_braking(b, a, 0.9 * drac)


def test_the_worst_conflicts_of_the_watched_equal_those_of_all_their_pairs() -> None:
    rng = np.random.default_rng(200_002)
    n = 30
    crowd = Boxes(
        rng.uniform(0, 300, n), rng.uniform(0, 15, n), rng.normal(0, 0.2, n), np.full(n, 5.0),
        np.full(n, 2.0), rng.uniform(0, 30, n),
    )  # fmt: skip
    watched = rng.random(n) < 0.4
    rows = np.flatnonzero(watched)
    ours = Boxes(*(np.asarray(v)[rows, None] for v in crowd))
    ttc = time_to_collision(ours, crowd, cap=10.0)  # [k,n]
    ttc[np.arange(len(rows)), rows] = 10.0  # not with oneself
    drac = deceleration_to_avoid_crash(ours, crowd)
    drac[~np.isfinite(drac) | (ttc >= 10.0)] = 0.0  # oneself and touching cars; too far ahead
    seen = conflicts(crowd, watched, horizon=10.0)
    assert np.array_equal(seen.rows, rows)
    assert seen.time_to_collision == pytest.approx(ttc.min(axis=1))
    assert seen.deceleration == pytest.approx(drac.max(axis=1))
    assert (seen.deceleration > 0.0).sum() >= 3


# ---- gap and headway -----------------------------------------------------------------------------------


def two_lane_road() -> RoadMap:
    def line(x0: float, x1: float, y: float) -> np.ndarray:
        return np.array([[x0, y], [x1, y]])

    return RoadMap(
        (
            Lane("a_0", "a", 0, line(0, 100, 0), 100.0, 3.2, 25.0, successors=(2,), left=1),
            Lane("a_1", "a", 1, line(0, 100, 3.2), 100.0, 3.2, 25.0, right=0),
            Lane("b_0", "b", 0, line(100, 300, 0), 200.0, 3.2, 25.0),
        )
    )


def on_lanes(lane: list[int], position: list[float], speed: list[float]) -> Snapshot:
    n = len(lane)
    return Snapshot(
        time=0.0, ids=tuple(f"v{k}" for k in range(n)), kind=np.ones(n, np.int8),
        mission=np.zeros(n, np.bool_), x=np.array(position), y=np.zeros(n), heading=np.zeros(n),
        speed=np.array(speed), accel=np.zeros(n),
        length=np.full(n, 5.0), width=np.full(n, 2.0), lane=np.array(lane, np.int32),
        lane_position=np.array(position),
    )  # fmt: skip


def test_the_gap_runs_from_bumper_to_bumper_across_lane_borders() -> None:
    snapshot = on_lanes([0, 2, 1, 0], [80.0, 20.0, 90.0, 30.0], [20.0] * 4)
    gap, leader = gap_ahead(snapshot, two_lane_road().straight_on, np.arange(4))
    assert gap == pytest.approx([20.0 + 20.0 - 5.0, np.inf, np.inf, 45.0])  # not the car in the next lane
    assert leader.tolist() == [1, -1, -1, 0]


def test_headway_is_gap_over_own_speed_and_means_nothing_in_a_queue() -> None:
    assert headway(np.array([30.0, 30.0, np.inf]), np.array([20.0, 0.0, 20.0])) == pytest.approx(
        [1.5, np.inf, np.inf]
    )


# ---- post-encroachment time ----------------------------------------------------------------------------


def drive(start: Boxes, interval: float, seconds: float) -> Boxes:
    t = np.arange(0.0, seconds, interval)
    ones = np.ones_like(t)
    return moved(Boxes(*(v * ones for v in start)), t)


@pytest.mark.parametrize("interval", [0.1, 0.2, 0.4])
def test_pet_of_a_right_angle_crossing_is_known(interval: float) -> None:
    """Both at 20 m/s; A's rear leaves the crossing at 2.675 s, B's nose enters it at 3.325 s."""
    a, b = drive(car(-50, 0, 0, 20), interval, 8.0), drive(car(0, -70, 90, 20), interval, 8.0)
    assert post_encroachment_time(a, b, interval) == pytest.approx(0.65, abs=1e-6)
    assert post_encroachment_time(b, a, interval) == pytest.approx(0.65, abs=1e-6)


@many
@given(va=st.floats(5, 25), vb=st.floats(5, 25), wait=st.floats(0.2, 4.0))
def test_pet_equals_the_time_between_leaving_and_entering_for_any_speeds(
    va: float, vb: float, wait: float
) -> None:
    leaves = (50.0 + 1.0 + 2.5) / va
    a = drive(car(-50, 0, 0, va), 0.2, 18.0)
    b = drive(car(0, -(leaves + wait) * vb - 3.5, 90, vb), 0.2, 18.0)
    assert post_encroachment_time(a, b, 0.2) == pytest.approx(wait, abs=1e-6)


def test_following_and_parallel_driving_have_no_pet() -> None:
    leader = drive(car(30, 0, 0, 20), 0.2, 8.0)
    assert post_encroachment_time(drive(car(0, 0, 0, 20), 0.2, 8.0), leader, 0.2) == np.inf
    assert post_encroachment_time(drive(car(0, 3.2, 0, 20), 0.2, 8.0), leader, 0.2) == np.inf
    beyond = drive(car(0, -230, 90, 20), 0.2, 16.0)  # crosses more than 5 s later
    assert post_encroachment_time(drive(car(-50, 0, 0, 20), 0.2, 16.0), beyond, 0.2) == np.inf


def test_the_smallest_encroachment_of_a_wide_crowd_is_that_of_its_worst_pair() -> None:
    rng = np.random.default_rng(200_001)
    n, frames, interval = 60, 26, 0.2
    drift = interval * np.arange(1 - frames, 1)[:, None]  # [T,1] s
    x, y, heading = rng.uniform(-300, 300, n), rng.uniform(-300, 300, n), rng.uniform(-3, 3, n)
    speed = rng.uniform(0, 30, n)
    course = np.cos(heading), np.sin(heading)
    trail = np.stack(
        np.broadcast_arrays(
            x + drift * speed * course[0], y + drift * speed * course[1], *course, speed, np.zeros(n)
        ),
        axis=-1,
    )  # [T,n,6]
    sizes = np.tile([5.0, 2.0], (n, 1))
    relevant = rng.random(n) < 0.3

    def smallest(rows: list[int]) -> float:
        parts = np.ascontiguousarray(trail[:, rows]), frames - 1, len(rows), sizes[rows], relevant[rows]
        return float(kernels.encroachment(*parts, interval, EVERYWHERE)[0])

    pairs = [smallest([a, b]) for a in range(n) for b in range(a)]
    assert sum(lag < 5.0 for lag in pairs) > 1
    assert smallest(list(range(n))) == min(pairs)


def test_the_clock_of_a_drive_stands_still_while_a_kernel_is_compiled() -> None:
    @numba.njit  # type: ignore[untyped-decorator]
    def added(a: float, b: float) -> float:
        return a + b

    spent, drive, wall = compiled.compilation_time(), compiled.clock(), time.perf_counter()
    added(1.0, 2.0)
    wall, drive = time.perf_counter() - wall, compiled.clock() - drive
    spent = compiled.compilation_time() - spent
    assert spent > 0.5 * wall, "to add two numbers takes no time, to compile it does"
    assert drive == pytest.approx(wall - spent, abs=0.5 * spent)  # a core may be taken between two looks
    before = compiled.compilation_time()
    added(3.0, 4.0)
    assert compiled.compilation_time() == before
