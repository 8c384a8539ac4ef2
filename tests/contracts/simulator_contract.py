"""What every `cosim.types.Simulator` must keep: inherit `SimulatorContract` and give it a `world` fixture.

The world must be the same road each time: at the start of an episode AV `a` drives at 20 m/s on the right
lane of two, a human `w` stands 220 m before it in its lane, the left lane is free, and a human `h` drives
150 m behind.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import pytest

from cosim.road import RoadMap
from cosim.types import Command, Kind, Receipt, Simulator, Snapshot, Timing

TIMING = Timing()
LANE = 3.2  # m
ARRAYS = (
    "kind",
    "mission",
    "x",
    "y",
    "heading",
    "speed",
    "accel",
    "length",
    "width",
    "lane",
    "lane_position",
)

Advanced = tuple[tuple[Receipt, ...], tuple[Snapshot, ...]]


class Probe:
    """A simulator whose attributes are methods too, so that it can be asked from another process."""

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self.reset, self.advance = simulator.reset, simulator.advance
        self.route, self.commanded = simulator.route, simulator.commanded
        self.counts = simulator.counts
        self._closed = False

    def close(self) -> None:
        self._simulator.close()
        self._closed = True

    def is_closed(self) -> bool:
        return self._closed

    def road(self) -> RoadMap:
        return self._simulator.road

    def goal_lanes(self) -> frozenset[int]:
        return self._simulator.goal_lanes


class World(Protocol):
    """A `cosim.workers.worker.Worker` around a Probe, or the like of it."""

    def call(self, method: str, *arguments: Any) -> Any: ...


class Here:
    """A World in this process."""

    def __init__(self, probe: Probe) -> None:
        self._probe = probe

    def call(self, method: str, *arguments: Any) -> Any:
        return getattr(self._probe, method)(*arguments)


def of(snapshot: Snapshot, name: str, vehicle: str = "a") -> float:
    return float(getattr(snapshot, name)[snapshot.row[vehicle]])


def drive(world: World, target: float, steps: int, lane: int = 0) -> list[Snapshot]:
    """Hold `target` m/s for `steps` decisions, the first of them with a lane change; every frame."""
    frames: list[Snapshot] = []
    for k in range(steps):
        done: Advanced = world.call("advance", [Command("a", target, lane if k == 0 else 0, TIMING.decision)])
        frames += done[1]
    return frames


class SimulatorContract:
    """Tests to inherit."""

    @pytest.fixture
    def begun(self, world: World) -> tuple[World, Snapshot]:
        """The world after a reset, and its newest frame."""
        frames: tuple[Snapshot, ...] = world.call("reset", 11)
        return world, frames[-1]

    def test_a_reset_brings_frames_in_order_with_everybody_sorted_by_id(self, world: World) -> None:
        frames: tuple[Snapshot, ...] = world.call("reset", 11)
        assert len(frames) >= 1
        times = [frame.time for frame in frames]
        assert np.diff(times) == pytest.approx(TIMING.frame)
        newest = frames[-1]
        assert list(newest.ids) == sorted(newest.ids)
        assert {"a", "h", "w"} <= set(newest.ids)
        assert all(len(getattr(newest, name)) == newest.n for name in ARRAYS)
        assert newest.kind[newest.row["a"]] == Kind.AV
        assert newest.kind[newest.row["h"]] == Kind.HV

    def test_a_decision_brings_its_frames(self, begun: tuple[World, Snapshot]) -> None:
        world, start = begun
        _, frames = world.call("advance", [])
        assert [f.time - start.time for f in frames] == pytest.approx([0.2, 0.4])

    def test_positions_are_vehicle_centres_on_the_lanes_of_the_map(
        self, begun: tuple[World, Snapshot]
    ) -> None:
        world, start = begun
        road: RoadMap = world.call("road")
        row = start.row["a"]
        lane = road.lanes[start.lane[row]]
        x, y, heading = road.path(int(start.lane[row])).pose(
            np.array([start.lane_position[row] - start.length[row] / 2])
        )
        assert (of(start, "x"), of(start, "y")) == pytest.approx((x[0], y[0]), abs=0.15)
        assert of(start, "heading") == pytest.approx(heading[0], abs=0.01)
        assert lane.edge == world.call("route", "a")[0]
        assert world.call("goal_lanes") <= set(range(len(road.lanes)))

    def test_the_same_seed_twice_is_bit_identical_and_another_is_not(self, world: World) -> None:
        def episode(seed: int) -> list[Snapshot]:
            return [*world.call("reset", seed), *drive(world, 15.0, 5, lane=1)]

        first, other, again = episode(3), episode(4), episode(3)
        for a, b in zip(first, again, strict=True):
            assert a.ids == b.ids
            assert all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ARRAYS)
        assert any(not np.array_equal(a.x, b.x) for a, b in zip(first, other, strict=True))

    def test_uncommanded_avs_have_no_target(self, begun: tuple[World, Snapshot]) -> None:
        world, _ = begun
        assert world.call("commanded", "a") == (None, 0)

    def test_a_command_is_held_and_tracked_within_the_limits(self, begun: tuple[World, Snapshot]) -> None:
        world, start = begun
        frames = drive(world, 10.0, 10)
        assert world.call("commanded", "a") == (10.0, 0)
        assert of(frames[-1], "speed") == pytest.approx(10.0, abs=0.2)
        speeds = [of(start, "speed"), *(of(f, "speed") for f in frames)]
        braking = np.diff(speeds) / TIMING.frame
        assert braking.min() == pytest.approx(-8.0, abs=0.5)  # brakes as hard as it may, not harder
        frames = drive(world, 20.0, 10)
        assert of(frames[-1], "speed") == pytest.approx(20.0, abs=0.5)
        assert np.diff([of(f, "speed") for f in frames]).max() / TIMING.frame == pytest.approx(3.0, abs=0.3)

    def test_a_standing_target_stops_the_vehicle_for_good(self, begun: tuple[World, Snapshot]) -> None:
        world, _ = begun
        frames = drive(world, 0.0, 15)
        assert of(frames[-1], "speed") == pytest.approx(0.0, abs=0.05)

    def test_a_lane_change_to_the_left_takes_two_seconds(self, begun: tuple[World, Snapshot]) -> None:
        world, start = begun
        y = of(start, "y")
        frames = drive(world, 20.0, 1, lane=1)
        assert world.call("commanded", "a") == (20.0, 1)
        frames += drive(world, 20.0, 2)
        assert 0.3 * LANE < of(frames[-1], "y") - y < 0.9 * LANE  # after 1.2 s
        frames += drive(world, 20.0, 3)
        assert of(frames[-1], "y") - y == pytest.approx(LANE, abs=0.1)  # after 2.4 s
        road: RoadMap = world.call("road")
        assert int(of(frames[-1], "lane")) == road.lanes[int(of(start, "lane"))].left
        assert world.call("commanded", "a") == (20.0, 0)

    def test_what_cannot_be_done_is_said_in_the_receipt(self, begun: tuple[World, Snapshot]) -> None:
        world, _ = begun
        hold = TIMING.decision
        receipts, _ = world.call("advance", [Command("a", 20.0, -1, hold), Command("nobody", 5.0, 0, hold)])
        assert receipts == (
            Receipt("a", False, "no lane on that side"),
            Receipt("nobody", False, "not on the road"),
        )
        receipts, _ = world.call("advance", [Command("a", 20.0, 1, hold)])
        assert receipts == (Receipt("a", True),)
        receipts, _ = world.call("advance", [Command("a", 20.0, 1, hold)])
        assert receipts == (Receipt("a", False, "a lane change is under way"),)

    def test_a_blocked_lane_change_still_carries_its_speed(self, begun: tuple[World, Snapshot]) -> None:
        world, _ = begun
        world.call("advance", [Command("a", 15.0, -1, TIMING.decision)])
        assert world.call("commanded", "a")[0] == 15.0

    def test_an_av_left_out_is_handed_back(self, begun: tuple[World, Snapshot]) -> None:
        world, _ = begun
        drive(world, 10.0, 5)
        frames = [f for _ in range(15) for f in world.call("advance", [])[1]]
        assert world.call("commanded", "a") == (None, 0)
        assert of(frames[10], "speed") > 12.0  # IDM takes it back towards the limit
        assert not any(f.events.collisions for f in frames)  # and brakes before `w`, 20 m/s later

    def test_vehicles_are_counted(self, begun: tuple[World, Snapshot]) -> None:
        world, start = begun
        counts = world.call("counts")
        assert counts["inserted"] >= start.n
        assert counts["waiting"] == 0

    def test_driving_into_somebody_is_reported_once_with_its_culprit(
        self, begun: tuple[World, Snapshot]
    ) -> None:
        world, _ = begun
        hits = [c for frame in drive(world, 20.0, 34) for c in frame.events.collisions]  # 270 m
        assert [(c.collider, c.victim) for c in hits] == [("a", "w")]
        assert hits[0].collider_is_av
        assert hits[0].av_caused
        assert not hits[0].victim_is_av

    def test_closing_twice_is_safe(self, begun: tuple[World, Snapshot]) -> None:
        world, _ = begun
        world.call("close")
        world.call("close")
