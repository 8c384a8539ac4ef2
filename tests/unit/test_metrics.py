"""One scripted drive per situation: what happened on the road, and the figures it must leave behind."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pytest

from cosim.metrics import METRICS, MetricContext, Metrics
from cosim.metrics.post_encroachment import PostEncroachment
from cosim.road import Lane, RoadMap
from cosim.types import Collision, EpisodeResult, Events, Identity, Kind, Metric, Overlap, Snapshot, Timing

FRAME = 0.2  # s


@dataclass(frozen=True)
class Car:
    """A vehicle on a script: its state as functions of time in s."""

    x: Callable[[float], float]
    y: Callable[[float], float] = lambda _: 0.0
    speed: Callable[[float], float] = lambda _: 20.0
    heading_deg: float = 0.0
    kind: Kind = Kind.HV
    mission: bool = False
    lane: Callable[[float], int] = lambda _: 0
    present: Callable[[float], bool] = lambda _: True


def steady(x0: float, speed: float, **more: Any) -> Car:
    """Drives along x at a constant speed (m, m/s)."""
    return Car(lambda t: x0 + speed * t, speed=lambda _: speed, **more)


def straight_road() -> RoadMap:
    def line(y: float) -> np.ndarray[Any, Any]:
        return np.array([[0.0, y], [3000.0, y]])

    return RoadMap(
        (
            Lane("main_0", "main", 0, line(0.0), 3000.0, 3.2, 30.0),
            Lane("main_1", "main", 1, line(3.2), 3000.0, 3.2, 30.0),
            Lane("ramp_0", "ramp", 0, line(-3.2), 3000.0, 3.2, 30.0),
        )
    )


def frame(cars: Mapping[str, Car], time: float, events: Events = Events()) -> Snapshot:
    ids = tuple(sorted(name for name, car in cars.items() if car.present(time)))
    here = [cars[name] for name in ids]
    n = len(ids)
    return Snapshot(
        time=100.0 + time,  # the clock does not start at 0: the warm-up is not counted
        ids=ids,
        kind=np.array([c.kind for c in here], np.int8),
        mission=np.array([c.mission for c in here], np.bool_),
        x=np.array([c.x(time) for c in here], np.float64),
        y=np.array([c.y(time) for c in here], np.float64),
        heading=np.radians(np.array([c.heading_deg for c in here], np.float64)),
        speed=np.array([c.speed(time) for c in here], np.float64),
        accel=np.zeros(n),
        length=np.full(n, 5.0),
        width=np.full(n, 2.0),
        lane=np.array([c.lane(time) for c in here], np.int32),
        lane_position=np.array([c.x(time) + 2.5 for c in here], np.float64),
        events=events,
    )


def drive(
    cars: Mapping[str, Car],
    seconds: float = 10.0,
    mission: str = "none",
    goal: frozenset[int] = frozenset(),
    events: Mapping[int, Events] | None = None,
    road: RoadMap | None = None,
    guessed: bool = False,
) -> dict[str, float | int | bool | None]:
    """The figures of a scripted drive; `events`: frame number -> what happened before it."""
    context = MetricContext(road or straight_road(), Timing(), mission, goal, seconds, guessed)
    metrics = Metrics()
    metrics.reset(frame(cars, 0.0), context)
    for k in range(1, round(seconds / FRAME) + 1):
        metrics.add(frame(cars, FRAME * k, (events or {}).get(k, Events())))
    return {name: metric.value for name, metric in metrics.result().items()}


def crash(collider: str, victim: str, **more: Any) -> Collision:
    made = Collision(0.0, collider, victim, False, False, "collision", "sumo", "main_0", 0.0, 0.0)
    return replace(made, **more)


def test_an_av_closing_on_a_slower_car_reports_its_smallest_ttc_and_its_share_of_critical_time() -> None:
    """Gap 45 m, closing at 10 m/s for 4 s: TTC 4.5 s falls to 0.5 s; the last 1 s lies below 1.5 s."""
    cars = {"av": steady(0.0, 20.0, kind=Kind.AV), "slow": steady(50.0, 10.0)}
    seen = drive(cars, 4.0)
    assert seen["min_ttc_s"] == pytest.approx(0.5)
    assert seen["max_drac_mps2"] == pytest.approx(10.0**2 / (2 * 5.0))
    # frames at 3.0 s (TTC 1.5 itself is not below) .. 4.0 s: 5 of 21
    assert seen["ttc_below_1_5_share"] == pytest.approx(5 / 21, abs=1 / 21)
    assert seen["min_headway_s"] == pytest.approx(5.0 / 20.0)
    assert seen["mean_headway_s"] == pytest.approx(25.0 / 20.0)  # the gap's mean is 25 m
    assert seen["crashed"] is False


def test_overtaking_side_by_side_is_no_conflict() -> None:
    cars = {
        "av": steady(0.0, 25.0, kind=Kind.AV),
        "hv": steady(50.0, 15.0, y=lambda _: 3.2, lane=lambda _: 1),
    }
    seen = drive(cars)
    assert seen["min_ttc_s"] is None
    assert seen["ttc_below_1_5_share"] == 0.0
    assert seen["max_drac_mps2"] == 0.0
    assert seen["min_pet_s"] is None
    assert seen["mean_headway_s"] is None  # nobody in its own lane


def test_a_crossing_leaves_its_known_post_encroachment_time() -> None:
    """The AV's rear leaves the crossing at 2.675 s, the other's nose enters it at 3.325 s."""
    north = Car(
        lambda _: 0.0, y=lambda t: -70.0 + 20.0 * t, heading_deg=90.0, lane=lambda _: -1, kind=Kind.HV
    )
    seen = drive({"av": steady(-50.0, 20.0, kind=Kind.AV), "north": north})
    assert seen["min_pet_s"] == pytest.approx(0.65)
    assert seen["min_ttc_s"] is None  # at constant speed they never touch


def test_those_who_left_are_forgotten_but_not_the_smallest_post_encroachment_time() -> None:
    """120 cars, one every half second; one of them crosses close behind the AV, the others elsewhere."""

    def passer(k: int) -> Car:
        start = 0.5 * k  # s
        return Car(
            lambda _: 0.0 if k == 20 else 400.0,
            y=lambda t: -70.0 + 20.0 * (t - start),
            heading_deg=90.0,
            lane=lambda _: -1,
            present=lambda t: start <= t < start + 8.0,
        )

    av = Car(lambda t: -50.0 + 20.0 * (t - 10.0), kind=Kind.AV, present=lambda t: 10.0 <= t < 20.0)
    cars = {"av": av} | {f"c{k:03}": passer(k) for k in range(120)}
    metric = PostEncroachment()
    metric.reset(frame(cars, 0.0), MetricContext(straight_road(), Timing(), "none", frozenset(), 80.0))
    for k in range(1, 400):
        metric.add(frame(cars, FRAME * k))
    assert metric.result()["min_pet_s"].value == pytest.approx(0.65)
    assert len(metric._slots) < 90
    assert metric._trail.shape[1] < 220


def test_a_car_on_a_bridge_is_in_no_conflict_with_one_below_it() -> None:
    """The same two drives: on a crossing they nearly meet, on a bridge only the map does."""

    def roads(southern_end: str) -> RoadMap:
        east, north = np.array([[-900.0, 0.0], [900.0, 0.0]]), np.array([[0.0, -900.0], [0.0, 900.0]])
        return RoadMap(
            (
                Lane("low_0", "low", 0, east, 1800.0, 3.2, 30.0, start="w", end="e"),
                Lane("high_0", "high", 0, north, 1800.0, 3.2, 30.0, start=southern_end, end="n"),
            )
        )

    def cars(away: float) -> dict[str, Car]:
        north = Car(lambda _: 0.0, y=lambda t: away + 20.0 * t, heading_deg=90.0, lane=lambda _: 1)
        return {"av": steady(-50.0, 20.0, kind=Kind.AV), "north": north}

    meeting = drive(cars(-52.0), road=roads("w"))
    assert meeting["min_ttc_s"] == pytest.approx(0.0, abs=0.2)
    assert meeting["max_drac_mps2"] > 5.0  # type: ignore[operator]
    assert drive(cars(-70.0), road=roads("w"))["min_pet_s"] == pytest.approx(0.65)
    for away in (-52.0, -70.0):
        bridge = drive(cars(away), road=roads("s"))
        assert bridge["min_ttc_s"] is None
        assert bridge["max_drac_mps2"] == 0.0
        assert bridge["min_pet_s"] is None


def test_conflicts_among_bystanders_are_not_the_avs() -> None:
    cars = {
        "a": steady(0.0, 20.0),
        "b": steady(30.0, 10.0),
        "c": Car(lambda _: 0.0, y=lambda t: -70.0 + 20.0 * t, heading_deg=90.0, lane=lambda _: -1),
        "av": steady(2000.0, 20.0, kind=Kind.AV),
    }
    seen = drive(cars, 2.0)
    assert seen["min_ttc_s"] is None
    assert seen["max_drac_mps2"] == 0.0
    assert seen["min_pet_s"] is None


def test_a_mission_vehicle_counts_in_conflicts_like_an_av() -> None:
    seen = drive({"m": steady(0.0, 20.0, mission=True), "hv": steady(50.0, 10.0)}, 4.0)
    assert seen["min_ttc_s"] == pytest.approx(0.5)


def test_a_guessed_mission_vehicle_counts_in_no_conflict_and_in_its_own_figures() -> None:
    cars = {"m": steady(0.0, 20.0, mission=True), "hv": steady(50.0, 10.0)}
    seen = drive(cars, 4.0, guessed=True)
    assert (seen["min_ttc_s"], seen["max_drac_mps2"]) == (None, None)
    assert seen["dt_mission_m"] == pytest.approx(80.0)


def test_one_hard_stop_is_one_hard_braking_and_its_jerk_is_known() -> None:
    """6 m/s2 from 4 s to 6 s: one event; two jerks of 6/0.2 m/s3 among 49 frame triples."""

    def speed(t: float) -> float:
        return 20.0 - 6.0 * min(max(t - 4.0, 0.0), 2.0)

    cars = {
        "av": Car(lambda t: 20.0 * t, speed=speed, kind=Kind.AV),
        "hv": Car(lambda t: 500.0 + 20.0 * t, speed=speed),
        "calm": Car(lambda t: 1000.0 + 20.0 * t, speed=lambda t: 20.0 - 2.0 * min(t, 5.0)),
    }
    seen = drive(cars)
    assert seen["hard_brakings"] == 2
    assert seen["hard_brakings_av"] == 1
    assert seen["mean_abs_jerk_mps3"] == pytest.approx(2 * 30.0 / 49)


def test_braking_twice_counts_twice() -> None:
    def speed(t: float) -> float:
        return 30.0 - 5.0 * (min(max(t - 1.0, 0.0), 1.0) + min(max(t - 4.0, 0.0), 1.0))

    assert drive({"av": Car(lambda t: 30.0 * t, speed=speed, kind=Kind.AV)})["hard_brakings_av"] == 2


def test_distance_is_the_mean_over_those_there_at_the_start_and_leavers_keep_theirs() -> None:
    cars = {
        "av": steady(0.0, 20.0, kind=Kind.AV),
        "hv": steady(100.0, 10.0),
        "left": steady(900.0, 30.0, present=lambda t: t < 4.1),
        "late": steady(0.0, 30.0, present=lambda t: t > 2.1, lane=lambda _: 1),
        "m": steady(300.0, 5.0, mission=True, lane=lambda _: 2),
    }
    seen = drive(cars)
    assert seen["dt_av_m"] == pytest.approx(200.0)
    assert seen["dt_hv_m"] == pytest.approx((100.0 + 120.0 + 50.0) / 3)
    assert seen["dt_mission_m"] == pytest.approx(50.0)
    assert seen["dt_mean_m"] == pytest.approx((200.0 + 100.0 + 120.0 + 50.0) / 4)


def test_distance_of_changing_speed_is_the_integral() -> None:
    cars = {"av": Car(lambda t: 10.0 * t + t * t, speed=lambda t: 10.0 + 2.0 * t, kind=Kind.AV)}
    assert drive(cars)["dt_av_m"] == pytest.approx(10.0 * 10.0 + 100.0)


def test_on_a_road_that_starts_empty_all_who_came_count() -> None:
    cars = {
        "a": steady(0.0, 10.0, present=lambda t: t > 0.1),
        "b": steady(50.0, 20.0, present=lambda t: t > 5.1),
    }
    assert drive(cars)["dt_mean_m"] == pytest.approx((9.8 * 10.0 + 4.8 * 20.0) / 2)


def test_a_teleport_is_not_driven() -> None:
    cars = {"hv": Car(lambda t: 20.0 * t + (700.0 if t > 5.0 else 0.0))}
    assert drive(cars)["dt_mean_m"] == pytest.approx(200.0)


def merging(at: float, **more: Any) -> Car:
    return steady(0.0, 20.0, mission=True, lane=lambda t: 0 if t >= at - 1e-9 else 2, **more)


def test_the_mission_succeeds_when_the_goal_lane_is_reached_and_says_when() -> None:
    seen = drive({"m": merging(4.0)}, mission="merge", goal=frozenset({0, 1}))
    assert seen["mission_success"] is True
    assert seen["mission_time_s"] == pytest.approx(4.0)
    assert seen["mission_failed_at_end"] is False


def test_without_a_goal_of_its_own_a_mission_begins_on_a_lane_that_gives_way() -> None:
    """Goal lanes are all but the one that gives way (2): driving on them from the start is no success."""
    goal = frozenset({0, 1})
    lanes = steady(0.0, 20.0, mission=True, lane=lambda t: 0 if t < 2.0 or t >= 4.0 - 1e-9 else 2)
    seen = drive({"m": lanes}, mission="auto", goal=goal)
    assert (seen["mission_success"], seen["mission_time_s"]) == (True, pytest.approx(4.0))
    assert drive({"m": steady(0.0, 20.0, mission=True)}, mission="auto", goal=goal)["mission_success"] is None


def test_without_a_goal_of_its_own_a_mission_ends_with_the_route_at_the_latest() -> None:
    lane = steady(0.0, 20.0, mission=True, lane=lambda _: 2)
    arrived = {30: Events(arrived=("m",))}
    seen = drive({"m": lane}, mission="auto", goal=frozenset({0}), events=arrived)
    assert (seen["mission_success"], seen["mission_time_s"]) == (True, pytest.approx(30 * FRAME))
    crashed = {20: Events(collisions=(crash("hv", "m"),)), **arrived}
    cars = {"m": lane, "hv": steady(-30.0, 20.0)}
    assert drive(cars, mission="auto", goal=frozenset({0}), events=crashed)["mission_success"] is False
    assert (
        drive({"m": lane}, mission="merge", goal=frozenset({0}), events=arrived)["mission_success"] is False
    )


def test_a_mission_vehicle_that_stands_at_the_end_of_its_lane_has_failed() -> None:
    stuck = Car(
        lambda t: min(20.0 * t, 120.0),
        speed=lambda t: 20.0 if t < 6.0 else 0.0,
        mission=True,
        lane=lambda _: 2,
    )
    seen = drive({"m": stuck}, mission="merge", goal=frozenset({0, 1}))
    assert seen["mission_success"] is False
    assert seen["mission_time_s"] is None
    assert seen["mission_failed_at_end"] is True


def test_a_collision_before_the_goal_is_no_success_but_one_after_it_is() -> None:
    hit = Events(collisions=(crash("hv", "m", involves_mission=True),))
    cars = {"m": merging(4.0), "hv": steady(-30.0, 20.0)}
    before = drive(cars, mission="merge", goal=frozenset({0}), events={10: hit})
    after = drive(cars, mission="merge", goal=frozenset({0}), events={40: hit})
    assert before["mission_success"] is False
    assert before["mission_time_s"] is None
    assert after["mission_success"] is True
    assert after["crashed"] is True


def test_a_mission_vehicle_found_while_running_counts_from_then() -> None:
    """`auto` names it late; its distance is still that of the whole counted time."""
    calm = merging(8.0)
    cars = {"m": calm}
    context = MetricContext(straight_road(), Timing(), "auto", frozenset({0}), 10.0)
    metrics = Metrics()
    metrics.reset(frame({"m": replace(calm, mission=False)}, 0.0), context)
    for k in range(1, 51):
        shown = cars if k > 10 else {"m": replace(calm, mission=False)}
        metrics.add(frame(shown, FRAME * k))
    seen = metrics.result()
    assert seen["mission_success"].value is True
    assert seen["dt_mission_m"].value == pytest.approx(200.0)


def test_collisions_count_pairs_once_and_say_who_was_to_blame() -> None:
    first = Events(
        collisions=(
            crash("av", "hv", collider_is_av=True, av_caused=True),
            crash("x", "y"),
            crash("hv", "av", victim_is_av=True),
        )
    )
    excused = tuple(Overlap(0.8, pair, "askew") for pair in (("x", "y"), ("p", "q"), ("q", "p")))
    again = Events(collisions=(crash("x", "y"),), overlaps=excused)
    cars = {"av": steady(0.0, 20.0, kind=Kind.AV), "hv": steady(100.0, 20.0)}
    seen = drive(cars, events={3: first, 5: again})
    assert seen["crashed"] is True
    assert seen["collisions"] == 2
    assert seen["uncounted_overlaps"] == 1, "a pair that collides is a collision alone"
    assert seen["av_caused_collisions"] == 1
    assert seen["hv_hv_collisions"] == 1


def test_teleports_and_emergency_stops_are_counted_by_vehicle_and_apart_from_crashes() -> None:
    halt = Events(emergency_stopped=("a",), teleported=("b",))
    seen = drive(
        {"a": steady(0.0, 20.0), "b": steady(100.0, 20.0)},
        events={3: halt, 4: halt, 5: Events(emergency_stopped=("b",))},
    )
    assert seen["emergency_stops"] == 2
    assert seen["teleports"] == 1
    assert seen["crashed"] is False


def test_what_does_not_apply_is_none_and_never_zero() -> None:
    empty = drive({}, 2.0)
    for name in (
        "mission_success", "mission_failed_at_end", "mission_time_s", "dt_mean_m", "dt_av_m", "dt_hv_m",
        "dt_mission_m", "min_ttc_s", "ttc_below_1_5_share", "min_pet_s", "max_drac_mps2",
        "hard_brakings", "hard_brakings_av", "mean_abs_jerk_mps3", "mean_headway_s", "min_headway_s",
    ):  # fmt: skip
        assert empty[name] is None, name
    no_av = drive({"hv": steady(0.0, 20.0), "m": merging(2.0)}, mission="none", goal=frozenset({0}))
    assert no_av["mission_success"] is None  # a mission vehicle, but no mission
    assert no_av["dt_av_m"] is None
    assert no_av["hard_brakings_av"] is None
    assert no_av["hard_brakings"] == 0


def test_vehicles_come_and_go_by_the_hundred() -> None:
    """More vehicles than any table was first made for; each is on the road for one second."""
    cars = {
        f"v{k:03d}": steady(
            -20.0 * 0.05 * k, 20.0, kind=Kind(k % 2), present=lambda t, k=k: 0.05 * k <= t < 0.05 * k + 1.0
        )
        for k in range(180)
    }
    seen = drive(cars, 10.0)
    assert seen["dt_mean_m"] == pytest.approx(16.0)  # only v000 was there at the start, for five frames
    assert seen["mean_abs_jerk_mps3"] == pytest.approx(0.0, abs=1e-9)


def test_two_episodes_in_a_row_do_not_mix() -> None:
    context = MetricContext(straight_road(), Timing(), "merge", frozenset({0}), 4.0)
    metrics = Metrics()
    results: list[dict[str, Metric]] = []
    wild = {"av": steady(0.0, 20.0, kind=Kind.AV), "slow": steady(50.0, 10.0), "m": merging(1.0)}
    calm = {"av": steady(0.0, 20.0, kind=Kind.AV), "m": merging(2.0)}
    for cars in (calm, wild, calm):
        metrics.reset(frame(cars, 0.0), context)
        for k in range(1, 21):
            metrics.add(frame(cars, FRAME * k))
        results.append(metrics.result())
    assert results[0] == results[2]
    assert results[0] != results[1]


def test_every_figure_has_a_unit_and_a_direction() -> None:
    metrics = Metrics()
    metrics.reset(
        frame({"av": steady(0.0, 20.0, kind=Kind.AV)}, 0.0),
        MetricContext(straight_road(), Timing(), "none", frozenset(), 1.0),
    )
    assert metrics.had_avs
    seen = metrics.result()
    assert len(seen) >= len(METRICS)
    for name, metric in seen.items():
        assert metric.unit, name
        assert metric.better in ("higher", "lower", ""), name


def test_a_document_is_plain_json_whatever_numbers_a_metric_returns() -> None:
    identity = Identity("merge", "free", "idm", None, "mixed", "lc2013", None, "lawful", 45.0, 0)
    figures = {"a": np.int64(3), "b": np.float64(0.5), "c": np.bool_(True), "d": np.inf, "e": None}
    metrics = {name: Metric(value, "", "") for name, value in figures.items()}  # type: ignore[arg-type]
    result = EpisodeResult(
        **asdict(identity), steps=1, trace_hash="", metrics=metrics, collisions=(), timings={}, validity=()
    )
    document = json.loads(json.dumps(result.document()))
    assert [document[name] for name in figures] == [3, 0.5, True, None, None]
