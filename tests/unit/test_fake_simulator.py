"""The shipped fake drives like cars do: followers keep their distance, overlaps are reported once."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.simulation.fake import LANE_WIDTH, FakeSimulator, FakeVehicle, straight_road
from cosim.types import Collision, Command, Snapshot


def drive(world: FakeSimulator, seconds: float, *commands: Command) -> list[Snapshot]:
    frames = []
    for _ in range(round(seconds / 0.4)):
        frames += world.advance(commands)[1]
    return frames


def collisions(frames: list[Snapshot]) -> list[Collision]:
    return [c for frame in frames for c in frame.events.collisions]


def test_a_human_on_a_free_road_reaches_the_desired_speed() -> None:
    world = FakeSimulator([FakeVehicle("h", 10.0, 0, 0.0, desired=25.0)])
    world.reset(0)
    assert drive(world, 40.0)[-1].speed[0] == pytest.approx(25.0, abs=0.3)


def test_a_human_stops_two_metres_behind_a_standing_car() -> None:
    world = FakeSimulator(
        [FakeVehicle("h", 100.0, 0, 20.0), FakeVehicle("standing", 300.0, 0, 0.0, desired=0.01)]
    )
    world.reset(0)
    frames = drive(world, 60.0)
    last = frames[-1]
    gap = last.x[last.row["standing"]] - last.x[last.row["h"]] - 5.0
    assert gap == pytest.approx(2.0, abs=0.5)  # IDM's d0
    assert not collisions(frames)


def test_two_humans_settle_at_idms_equilibrium_gap() -> None:
    world = FakeSimulator(
        [FakeVehicle("back", 50.0, 0, 15.0), FakeVehicle("front", 100.0, 0, 15.0, desired=15.0)], length=9e3
    )
    world.reset(0)
    last = drive(world, 120.0)[-1]
    gap = last.x[last.row["front"]] - last.x[last.row["back"]] - 5.0
    v = last.speed[last.row["back"]]
    assert v == pytest.approx(15.0, abs=0.1)
    assert gap == pytest.approx((2.0 + 1.0 * v) / np.sqrt(1.0 - (v / 25.0) ** 4), rel=0.05)


def test_an_av_that_never_brakes_hits_the_car_ahead_and_is_blamed_once() -> None:
    world = FakeSimulator(
        [FakeVehicle("av", 100.0, 0, 20.0, is_av=True), FakeVehicle("h", 200.0, 0, 5.0, desired=5.0)]
    )
    world.reset(0)
    (hit,) = collisions(drive(world, 20.0, Command("av", 20.0, 0, 0.4)))
    assert (hit.collider, hit.victim, hit.av_caused) == ("av", "h", True)
    assert 5.0 < hit.time < 8.0  # 95 m of gap, 15 m/s faster, +-2 m of jitter


def test_cars_side_by_side_do_not_touch() -> None:
    world = FakeSimulator([FakeVehicle("a", 100.0, 0, 20.0), FakeVehicle("b", 100.0, 1, 20.0)])
    world.reset(0)
    assert not collisions(drive(world, 10.0))


def test_a_lane_change_into_a_car_beside_is_a_collision() -> None:
    world = FakeSimulator([FakeVehicle("a", 100.0, 0, 20.0, is_av=True), FakeVehicle("b", 101.0, 1, 20.0)])
    world.reset(0)
    assert len(collisions(drive(world, 2.0, Command("a", 20.0, 1, 0.4)))) == 1


def test_who_drives_off_the_end_is_gone() -> None:
    world = FakeSimulator([FakeVehicle("a", 90.0, 0, 20.0), FakeVehicle("b", 10.0, 0, 20.0)], length=120.0)
    world.reset(0)
    assert drive(world, 2.4)[-1].ids == ("b",)


def test_the_seed_moves_everybody_by_a_metre_at_most() -> None:
    world = FakeSimulator([FakeVehicle("a", 100.0, 0, 20.0), FakeVehicle("b", 200.0, 1, 20.0)])
    x = np.array([world.reset(seed)[-1].x for seed in range(30)])
    assert np.abs(x - [97.5, 197.5]).max() <= 1.0  # centres are half a car behind the bumper
    assert np.unique(x, axis=0).shape == (30, 2)


def test_the_road_is_straight_lanes_side_by_side_from_the_right() -> None:
    road = straight_road(3, 500.0, 30.0)
    assert [lane.shape[0, 1] for lane in road.lanes] == pytest.approx([1.6, 4.8, 8.0])
    assert [(lane.left, lane.right) for lane in road.lanes] == [(1, -1), (2, 0), (-1, 1)]
    assert road.lanes[0].width == LANE_WIDTH


def test_looking_ahead_tells_what_comes_and_changes_nothing() -> None:
    world = FakeSimulator([FakeVehicle("a", 100.0, 0, 20.0, is_av=True), FakeVehicle("h", 60.0, 0, 20.0)])
    world.reset(0)
    faster = Command("a", 28.0, 0, 0.4)
    foreseen = world.ahead(4, [faster])
    again = world.ahead(4, [faster])
    came = drive(world, 0.8, faster)
    for frame, same, real in zip(foreseen, again, came, strict=True):
        assert (frame.x == same.x).all()
        assert (frame.x == real.x).all()
        assert frame.time == real.time
