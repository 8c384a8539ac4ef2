"""Everybody's figures: no vehicle that wanted to depart is forgotten, and no crash makes them better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from cosim.metrics import MetricContext, Metrics
from cosim.road import Lane, RoadMap
from cosim.types import Collision, Due, Events, Kind, Snapshot, Timing

BEGIN, FRAME = 100.0, 0.2  # s: the clock does not start at 0, the warm-up is not counted


@dataclass(frozen=True)
class Car:
    """A vehicle at one frame."""

    time_loss: float = 0.0  # s since it departed
    speed: float = 10.0  # m/s
    kind: Kind = Kind.HV
    co2: float = 2.0  # g/s


def frame(
    k: int,
    cars: Mapping[str, Car],
    events: Events = Events(),
    waiting: Mapping[str, Due] | None = None,
    known: bool = True,
) -> Snapshot:
    names, here = tuple(sorted(cars)), [cars[name] for name in sorted(cars)]
    n = len(here)
    place = 50.0 * np.arange(n)  # m, far from one another
    return Snapshot(
        time=BEGIN + FRAME * k,
        ids=names,
        kind=np.array([c.kind for c in here], np.int8),
        mission=np.zeros(n, np.bool_),
        x=place,
        y=np.zeros(n),
        heading=np.zeros(n),
        speed=np.array([c.speed for c in here], np.float64),
        accel=np.zeros(n),
        length=np.full(n, 5.0),
        width=np.full(n, 2.0),
        lane=np.zeros(n, np.int32),
        lane_position=place,
        events=events,
        **({"time_loss": np.array([c.time_loss for c in here], np.float64)} if known else {}),
        **({"co2": np.array([c.co2 for c in here], np.float64)} if known else {}),
        waiting={} if waiting is None and known else waiting,
    )


def figures(
    frames: Sequence[Snapshot], duration: float = 1.0, ends: bool = False
) -> dict[str, float | int | bool | None]:
    shape = np.array([[0.0, 0.0], [2000.0, 0.0]])
    road = RoadMap((Lane("road_0", "road", 0, shape, 2000.0, 3.2, 20.0),))
    metrics = Metrics()
    context = MetricContext(road, Timing(), "none", frozenset(), duration, ends=ends)
    metrics.reset(frames[0], context)
    for snapshot in frames[1:]:
        metrics.add(snapshot)
    return {name: metric.value for name, metric in metrics.result().items()}


def test_what_was_lost_before_the_clock_started_does_not_count() -> None:
    """a loses 3 s of its 53, b, an AV, has waited to be inserted for 40 s, 0.6 of them counted, c for 0.4."""
    due = {"b": Due(BEGIN - 39.4, True)}
    entered = Events(departed=("b", "c"), depart_delays=(40.0, 0.4))
    found = figures(
        [
            frame(0, {"a": Car(50.0)}, waiting=due),
            frame(2, {"a": Car(51.0)}, waiting=due),
            frame(3, {"a": Car(52.0), "b": Car(0.0, kind=Kind.AV), "c": Car(0.0)}, entered),
            frame(5, {"a": Car(53.0), "b": Car(0.2, kind=Kind.AV), "c": Car(0.1)}),
        ]
    )
    assert found["vehicles_due"] == 3
    assert found["total_delay_av_s"] == pytest.approx(0.6 + 0.2)
    assert found["total_delay_hv_s"] == pytest.approx((3.0 + 0.4 + 0.1) / 2)
    assert found["total_delay_s"] == pytest.approx((3.0 + 0.8 + 0.5) / 3)
    assert found["total_delay_slowest_tenth_s"] == pytest.approx(3.0)


def test_who_is_never_inserted_waits_to_the_horizon() -> None:
    due = {"late": Due(BEGIN + 0.5, False), "early": Due(BEGIN - 7.0, True)}
    found = figures(
        [frame(0, {"a": Car()}, waiting={"early": due["early"]}), frame(5, {"a": Car()}, waiting=due)]
    )
    assert found["total_delay_av_s"] == pytest.approx(1.0)
    assert found["total_delay_hv_s"] == pytest.approx((0.0 + 0.5) / 2)
    assert found["longest_wait_s"] == pytest.approx(1.0)
    assert found["mean_squared_wait_s2"] == pytest.approx((1.0 + 0.25) / 3)


def test_who_left_keeps_its_delay_and_has_arrived_unless_it_was_a_wreck() -> None:
    """a arrives; b, an AV, is taken off the road, last seen 0.8 s before the end, which it loses too."""
    cars = {"a": Car(0.5), "b": Car(1.0, kind=Kind.AV), "c": Car(0.0)}
    begun = {"a": Car(), "b": Car(kind=Kind.AV), "c": Car()}
    gone = Events(arrived=("a", "b"), wrecks_removed=("b",))
    found = figures([frame(0, begun), frame(1, cars), frame(2, {"c": Car()}, gone), frame(5, {"c": Car()})])
    assert (found["arrivals"], found["arrivals_av"], found["arrivals_hv"]) == (1, 0, 1)
    assert found["total_delay_hv_s"] == pytest.approx(0.25)
    assert found["total_delay_av_s"] == pytest.approx(1.0 + 0.8)


@pytest.mark.parametrize("ends", [True, False])
def test_a_crash_that_ends_the_episode_makes_nobody_less_late(ends: bool) -> None:
    """At 0.4 s of 10: everybody loses the 9.6 s that are left, and stands for them."""
    hit = Collision(BEGIN + 0.4, "av", "hv", True, False, "collision", "sumo", "road_0", 0.0, 0.0)
    cars = {"av": Car(kind=Kind.AV), "hv": Car()}
    due = {"late": Due(BEGIN, False)}
    crash = frame(2, cars, Events(collisions=(hit,)), waiting=due)
    found = figures([frame(0, cars), crash], 10.0, ends)
    assert found["total_delay_av_s"] == pytest.approx(9.6 if ends else 0.0)
    assert found["total_delay_hv_s"] == pytest.approx((9.6 + 10.0) / 2 if ends else 0.2)
    assert found["longest_wait_s"] == pytest.approx(10.0 if ends else 0.4)


def test_a_wait_is_forgotten_twice_as_fast_and_a_planned_stop_is_none() -> None:
    """a waits for 1 s, drives for 0.4, waits for 0.4 more: 1, 0.2 and 0.6 s. The bus stands at its stop."""
    speeds = [0.0] * 6 + [5.0] * 2 + [0.5] * 2
    at_stop = Events(stopped=("bus",))
    frames = [
        frame(k, {"a": Car(speed=speed), "bus": Car(speed=0.0)}, at_stop) for k, speed in enumerate(speeds)
    ]
    found = figures(frames)
    assert found["longest_wait_s"] == pytest.approx(1.0)
    assert found["mean_squared_wait_s2"] == pytest.approx((1.0 + 0.6**2 - 0.2**2) / 2)


def test_speed_and_co2_are_over_all_vehicles_on_the_road() -> None:
    cars = {"fast": Car(speed=20.0, co2=3.0), "slow": Car(speed=5.0, co2=1.0)}
    found = figures([frame(0, cars), frame(5, cars)])
    assert found["mean_speed_mps"] == pytest.approx(12.5)
    assert found["co2_kg"] == pytest.approx(0.004)
    assert found["co2_kg_per_vehicle_km"] == pytest.approx(0.004 / 0.025)


def test_what_the_simulator_does_not_tell_is_na() -> None:
    found = figures([frame(k, {"a": Car()}, known=False) for k in (0, 5)])
    unknown = ("total_delay_s", "total_delay_hv_s", "total_delay_slowest_tenth_s", "vehicles_due")
    assert {found[name] for name in (*unknown, "longest_wait_s", "co2_kg", "co2_kg_per_vehicle_km")} == {None}
    assert found["mean_speed_mps"] == 10.0
