"""What counts as a near-miss: which pairs, how often, and on which roads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pytest

from cosim.geometry import boxes, time_to_collision
from cosim.metrics import MetricContext, Metrics
from cosim.road import Lane, RoadMap
from cosim.types import Kind, Snapshot, Timing
from tests.unit.test_metrics import FRAME, Car, drive, steady

MEASURES = ("ttc", "drac", "pet")


def counts(cars: Mapping[str, Car], seconds: float = 10.0, road: RoadMap | None = None) -> dict[str, int]:
    """What is counted of anybody; with an AV under `av_...`."""
    seen = drive(cars, seconds, road=road)
    names = [f"{who}near_misses_{kind}" for who in ("", "av_") for kind in MEASURES]
    return {name.replace("near_misses_", ""): seen[name] for name in names}  # type: ignore[misc]


def crossing(after: float, speed: float = 20.0, **more: object) -> dict[str, Car]:
    """An AV eastwards, and one who comes from the south `after` s later to where it was."""
    north = Car(
        lambda _: 0.0,
        y=lambda t: -50.0 - 20.0 * after + 20.0 * t,
        heading_deg=90.0,
        lane=lambda _: -1,
        **more,  # type: ignore[arg-type]
    )
    return {"av": steady(-50.0, speed, kind=Kind.AV), "north": north}


def test_humans_who_come_near_count_for_all_and_not_for_the_avs() -> None:
    """Gap 45 m, closing at 10 m/s for 4 s: TTC down to 0.5 s, DRAC up to 10 m/s2."""
    cars = {"a": steady(0.0, 20.0), "b": steady(50.0, 10.0)}
    far_av = {"av": steady(2000.0, 20.0, kind=Kind.AV)}
    assert counts(cars | far_av, 4.0) == {
        "ttc": 1, "drac": 1, "pet": 0, "av_ttc": 0, "av_drac": 0, "av_pet": 0,
    }  # fmt: skip
    assert counts(cars, 4.0)["av_ttc"] is None  # NA without AVs


def test_with_an_av_in_it_an_encounter_counts_for_both() -> None:
    cars = {"av": steady(0.0, 20.0, kind=Kind.AV), "b": steady(50.0, 10.0)}
    seen = counts(cars, 4.0)
    assert (seen["ttc"], seen["av_ttc"], seen["drac"], seen["av_drac"]) == (1, 1, 1, 1)


@pytest.mark.parametrize(("calm", "expected"), [(0.6, 1), (2.0, 2)])
def test_a_pair_counts_once_until_it_has_been_calm_for_a_second(calm: float, expected: int) -> None:
    """10 m behind and 10 m/s faster (TTC 1 s), then as fast as the other for `calm` s, then faster."""
    first = 1.0

    def speed(t: float) -> float:
        return 20.0 if t < first or t >= first + calm - 1e-9 else 10.0

    cars = {
        "a": Car(lambda t: 10.0 * t, speed=speed),
        "b": steady(15.0, 10.0),
    }
    assert counts(cars, first + calm + 1.0)["ttc"] == expected


def test_who_touches_already_opens_no_encounter() -> None:
    """Two cars askew overlap for as long as they stand: that is a collision, or none, but no near-miss."""
    cars = {"a": steady(0.0, 0.0), "b": steady(3.0, 0.0, y=lambda _: 1.0)}
    assert counts(cars)["ttc"] == 0


def test_a_short_post_encroachment_time_is_one_near_miss() -> None:
    """The AV's rear leaves the crossing at 2.675 s, the other's nose enters it at 3.325 s: 0.65 s."""
    assert counts(crossing(1.0))["pet"] == 1
    assert counts(crossing(1.0))["av_pet"] == 1
    assert counts(crossing(1.5))["pet"] == 0  # 1.15 s


def test_persons_count_with_vehicles_and_not_with_one_another() -> None:
    assert counts(crossing(1.0, kind=Kind.PERSON))["pet"] == 1
    walkers = {
        name: Car(car.x, car.y, car.speed, car.heading_deg, Kind.PERSON, lane=lambda _: -1)
        for name, car in crossing(1.0).items()
    }
    assert counts(walkers | {"far": steady(900.0, 1.0)})["pet"] == 0


class Driver(NamedTuple):
    """Follows the centre lines of lanes at constant speed."""

    lanes: tuple[int, ...]
    front: float  # m, of its front bumper on the first lane at the start
    speed: float  # m/s
    kind: Kind = Kind.HV


def snapshot(road: RoadMap, drivers: Mapping[str, Driver], time: float) -> Snapshot:
    rows = []
    for d in drivers.values():
        ends = np.cumsum([road.lanes[k].length for k in d.lanes])
        front = d.front + d.speed * time
        now = int(np.searchsorted(ends, front, side="right"))
        line = np.concatenate([road.lanes[k].shape for k in d.lanes])
        line = line[np.append(True, np.hypot(*np.diff(line, axis=0).T) > 1e-6)]
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        nose, tail = (
            np.array([np.interp(at, arc, line[:, k]) for k in (0, 1)]) for at in (front, front - 5.0)
        )
        heading = np.arctan2(nose[1] - tail[1], nose[0] - tail[0])
        position = front - (ends[now - 1] if now else 0.0)
        rows.append((*(0.5 * (nose + tail)), heading, d.speed, d.lanes[now], position))
    x, y, heading, speed, lane, position = np.array(rows).T
    n = len(rows)
    return Snapshot(
        time=time,
        ids=tuple(drivers),
        kind=np.array([d.kind for d in drivers.values()], np.int8),
        mission=np.zeros(n, np.bool_),
        x=x, y=y, heading=heading, speed=speed, accel=np.zeros(n),
        length=np.full(n, 5.0), width=np.full(n, 2.0),
        lane=lane.astype(np.int32), lane_position=position,
    )  # fmt: skip


def followed(road: RoadMap, drivers: Mapping[str, Driver], seconds: float) -> dict[str, int]:
    """What is counted of all where everybody follows its lanes; `drivers` in the order of their names."""
    metrics = Metrics()
    context = MetricContext(road, Timing(), "none", frozenset(), seconds)
    metrics.reset(snapshot(road, drivers, 0.0), context)
    for k in range(1, round(seconds / FRAME) + 1):
        metrics.add(snapshot(road, drivers, FRAME * k))
    seen = metrics.result()
    return {kind: seen[f"near_misses_{kind}"].value for kind in MEASURES}  # type: ignore[misc]


def test_on_a_bridge_and_below_it_nobody_comes_near() -> None:
    east, north = np.array([[-900.0, 0.0], [900.0, 0.0]]), np.array([[0.0, -900.0], [0.0, 900.0]])
    for end, expected in (("w", 1), ("s", 0)):
        road = RoadMap(
            (
                Lane("low_0", "low", 0, east, 1800.0, 3.2, 30.0, start="w", end="e"),
                Lane("high_0", "high", 0, north, 1800.0, 3.2, 30.0, start=end, end="n"),
            )
        )
        first = Driver((0,), 852.5, 20.0)
        assert followed(road, {"a": first, "b": Driver((1,), 852.5, 20.0)}, 2.0)["ttc"] == expected
        assert followed(road, {"a": first, "b": Driver((1,), 832.5, 20.0)}, 6.0)["pet"] == expected


def fork() -> RoadMap:
    """From the south one either bends to the east or goes straight on across a road from the east."""
    turn = np.linspace(0.0, np.pi / 2, 19)
    bend = np.stack([10.0 - 10.0 * np.cos(turn), -11.6 + 10.0 * np.sin(turn)], axis=1)
    length = float(np.hypot(*np.diff(bend, axis=0).T).sum())
    inside = {"internal": True, "start": "J", "end": "J"}
    return RoadMap(
        (
            Lane("s_0", "s", 0, np.array([[0.0, -200.0], [0.0, -11.6]]), 188.4, 3.2, 15.0, (1, 3), end="J"),
            Lane(":J_0_0", ":J_0", 0, bend, length, 3.2, 15.0, (2,), **inside),  # type: ignore[arg-type]
            Lane("out_0", "out", 0, np.array([[10.0, -1.6], [200.0, -1.6]]), 190.0, 3.2, 15.0, start="J"),
            Lane(":J_1_0", ":J_1", 0, np.array([[0.0, -11.6], [0.0, 9.0]]), 20.6, 3.2, 15.0, **inside),  # type: ignore[arg-type]
            Lane("in_0", "in", 0, np.array([[200.0, 1.6], [-90.0, 1.6]]), 290.0, 3.2, 15.0, end="J"),
        )
    )


SOUTH, BEND, OUT, ACROSS, IN = range(5)


def test_who_bends_away_beside_oncoming_traffic_comes_near_to_nobody() -> None:
    """Straight on they would touch; along its lane it drives past them, on the other side of the road."""
    turning = Driver((SOUTH, BEND, OUT), 180.0, 8.0)
    oncoming = Driver((IN,), 165.0, 8.0)
    frames = [snapshot(fork(), {"a": oncoming, "b": turning}, FRAME * k) for k in range(25)]
    ways = [boxes(frame, np.array([row])) for frame in frames for row in (0, 1)]
    straight = [time_to_collision(*pair)[0] for pair in zip(ways[::2], ways[1::2], strict=True)]
    assert min(straight) < 1.5
    assert followed(fork(), {"a": oncoming, "b": turning}, 5.0)["ttc"] == 0


def test_who_goes_straight_on_where_others_bend_away_comes_near() -> None:
    oncoming = Driver((IN,), 176.0, 8.0)
    assert followed(fork(), {"a": oncoming, "b": Driver((SOUTH, ACROSS), 174.0, 8.0)}, 3.0)["ttc"] == 1


def test_who_follows_through_a_bend_has_not_crossed_the_others_way() -> None:
    """1.1 s behind, so that in the bend its nose is where the other's tail was 0.4 s before."""
    first, second = (Driver((SOUTH, BEND, OUT), front, 8.0) for front in (175.0, 166.5))
    assert followed(fork(), {"a": first, "b": second}, 6.0)["pet"] == 0
    parting = Driver((SOUTH, ACROSS), 166.5, 8.0)
    assert followed(fork(), {"a": first, "b": parting}, 3.5)["pet"] == 0


def test_vehicle_hours_are_those_of_vehicles_on_the_road() -> None:
    cars = {
        "av": steady(0.0, 20.0, kind=Kind.AV, present=lambda t: t > 2.1),
        "hv": steady(500.0, 10.0),
        "walker": steady(900.0, 1.0, kind=Kind.PERSON),
    }
    seen = drive(cars, 10.0)
    assert seen["vehicle_hours"] == pytest.approx((10.0 + 8.0) / 3600.0, abs=1e-9)
    assert seen["av_hours"] == pytest.approx(8.0 / 3600.0, abs=1e-9)  # first seen at 2.2 s
