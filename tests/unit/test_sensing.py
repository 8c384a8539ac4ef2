"""Physics of sensing: who is hidden, how old a message is, how losses come, when a track ends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_scenes import straight_road

from cosim.errors import BadInput
from cosim.observation.observer import Observer
from cosim.policies import compensator
from cosim.road import Lane, RoadMap
from cosim.scenario import load
from cosim.scenario.manifest import manifest
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.sensing import Parameters, asked, levels, read
from cosim.sensing import kernels
from cosim.sensing.perception import PREDICTED, Perception
from cosim.types import Actor, Kind, ObservationConfig, Percept, Snapshot, Source, Timing, Unseen

FRAME = 0.2  # s
ROAD = straight_road(lanes=3, at=2000.0)


@dataclass
class Car:
    """It drives at a constant speed along its lane from `x` m at 0 s on."""

    name: str
    x: float
    lane: int = 1
    speed: float = 20.0
    kind: Kind = Kind.HV
    actor: Actor = Actor.CAR
    length: float = 5.0
    width: float = 2.0
    leaves: float = math.inf  # s
    accel: float = 0.0  # m/s2
    signals: float = math.inf  # s, from then on to the left


def snapshot(cars: list[Car], time: float) -> Snapshot:
    """The cars at `time`, those left out that have left."""
    cars = sorted((car for car in cars if time < car.leaves - 1e-9), key=lambda car: car.name)

    def column(get: Any, dtype: Any = np.float64) -> Any:
        return np.array([get(car) for car in cars], dtype)

    x = column(lambda car: car.x + car.speed * time + 0.5 * car.accel * time**2)
    length = column(lambda car: car.length)
    lane = column(lambda car: car.lane, np.int32)
    return Snapshot(
        time=time,
        ids=tuple(car.name for car in cars),
        kind=column(lambda car: car.kind, np.int8),
        mission=np.zeros(len(cars), np.bool_),
        x=x,
        y=np.array([float(ROAD.lanes[k].shape[0, 1]) for k in lane]),
        heading=np.zeros(len(cars)),
        speed=column(lambda car: car.speed + car.accel * time),
        accel=column(lambda car: car.accel),
        length=length,
        width=column(lambda car: car.width),
        lane=lane,
        lane_position=x + 0.5 * length,
        actor=column(lambda car: car.actor, np.int8),
        indicator=column(lambda car: time >= car.signals - 1e-9, np.int8),
    )


def drive(
    cars: list[Car], frames: int, seed: int = 1, **parameters: Any
) -> Iterator[tuple[Snapshot, Mapping[str, Percept]]]:
    """Frame by frame: the truth, and what the AVs know."""
    perception = Perception(ROAD, Parameters(**parameters), Timing(), seed)
    for k in range(frames):
        truth = snapshot(cars, k * FRAME)
        yield truth, perception.perceive(truth)


def last(
    cars: list[Car], frames: int, seed: int = 1, **parameters: Any
) -> tuple[Snapshot, Mapping[str, Percept]]:
    *_, newest = drive(cars, frames, seed, **parameters)
    return newest


def of(percept: Percept, name: str) -> dict[str, float]:
    """What an AV knows of one vehicle."""
    row, world = percept.world.row[name], percept.world
    known = {n: float(getattr(world, n)[row]) for n in ("x", "y", "speed", "heading", "lane_position")}
    return known | {"age": float(percept.age[row]), "source": int(percept.source[row])}


EGO = Car("ego", 0.0, kind=Kind.AV)
MESSAGES: dict[str, Any] = {"range": 1.0, "cam": True, "forget": 3.0}  # own sensors reach nobody


# ---- own sensors ----


def test_with_perfect_sensors_an_av_knows_everything_as_it_is() -> None:
    cars = [EGO, Car("a", 40.0, signals=0.6), Car("b", 300.0, 0, accel=-2.0), Car("c", 80.0, 2, 31.0)]
    for truth, percepts in drive(cars, 8):
        world = percepts["ego"].world
        assert world.ids == truth.ids
        for name in ("x", "y", "speed", "heading", "lane", "lane_position", "length", "kind", "indicator"):
            np.testing.assert_allclose(getattr(world, name), getattr(truth, name), atol=1e-3, err_msg=name)
        assert not percepts["ego"].age.any()


@pytest.mark.parametrize("long", [True, False])
def test_behind_a_truck_nobody_is_seen(long: bool) -> None:
    truck = Car("truck", 30.0, actor=Actor.TRUCK, length=12.0, width=2.5)
    hidden, beside = Car("hidden", 60.0), Car("beside", 60.0, 2)
    cars = [EGO, hidden, beside, *([truck] if long else [])]
    _, percepts = last(cars, 3, line_of_sight=True)
    known = percepts["ego"].world.ids
    assert ("hidden" in known) is not long
    assert "beside" in known
    assert percepts["ego"].unseen == ({"hidden": Unseen.HIDDEN} if long else {})
    _, percepts = last(cars, 3, line_of_sight=False)
    assert "hidden" in percepts["ego"].world.ids


HOUSE = np.array([[25.0, 5.0], [45.0, 5.0], [45.0, 30.0], [25.0, 30.0]])  # m


def seen_past(*buildings: np.ndarray) -> Percept:
    """What an AV at (0, 0) knows of five cars in a row, at (20, 6) to (100, 30)."""
    perception = Perception(ROAD, Parameters(line_of_sight=True), Timing(), 1, buildings=buildings)
    truth = snapshot([EGO, *(Car(f"v{k}", 20.0 * k, length=1.0, width=1.0) for k in range(1, 6))], 0.0)
    apart = replace(truth, y=0.3 * truth.x, actor=np.full(truth.n, Actor.MOTORCYCLE, np.int8))
    return perception.perceive(apart)["ego"]


def test_behind_a_building_nobody_is_seen() -> None:
    assert set(seen_past().world.ids) == {"ego", "v1", "v2", "v3", "v4", "v5"}
    percept = seen_past(HOUSE)
    assert set(percept.world.ids) == {"ego", "v1"}  # v2 stands inside, the others behind
    assert percept.unseen == dict.fromkeys(("v2", "v3", "v4", "v5"), Unseen.HIDDEN)
    behind_the_ego = HOUSE * (-1.0, 1.0)
    assert seen_past(behind_the_ego, HOUSE[::-1]).unseen == percept.unseen


def test_a_building_hides_what_is_in_its_shadow_alone() -> None:
    wall = np.array([[30.0, -5.0], [30.0, 5.0]])
    cars = [EGO, Car("near", 20.0), Car("far", 60.0), Car("aside", 60.0, 2), Car("back", -40.0)]
    perception = Perception(ROAD, Parameters(line_of_sight=True), Timing(), 1, buildings=[wall])
    truth = snapshot(cars, 0.0)
    y = np.array([{"aside": 20.0}.get(name, 0.0) for name in truth.ids])
    assert perception.perceive(replace(truth, y=y))["ego"].unseen == {"far": Unseen.HIDDEN}


def test_a_building_around_an_av_hides_nothing() -> None:
    tunnel = np.array([[-50.0, -20.0], [200.0, -20.0], [200.0, 20.0], [-50.0, 20.0]])
    assert not seen_past(tunnel).unseen


def test_a_motorcycle_hides_nobody_and_a_truck_is_seen_over_nobody() -> None:
    rider = Car("rider", 30.0, actor=Actor.MOTORCYCLE, length=2.2, width=0.9)
    _, percepts = last([EGO, rider, Car("behind", 60.0)], 2, line_of_sight=True)
    assert set(percepts["ego"].world.ids) == {"ego", "rider", "behind"}


def test_range_and_field_of_view_end_where_they_say() -> None:
    cars = [EGO, Car("near", 99.0), Car("far", 101.0), Car("back", -30.0), Car("side", 1.0, 2)]
    _, percepts = last(cars, 2, range=100.0)
    assert set(percepts["ego"].world.ids) == {"ego", "near", "back", "side"}
    _, percepts = last(cars, 2, range=100.0, field_of_view=120.0)
    assert set(percepts["ego"].world.ids) == {"ego", "near"}


def test_misses_and_noise_have_the_size_that_is_asked_for() -> None:
    cars = [EGO, *(Car(f"v{k}", 10.0 * k - 200.0) for k in range(41) if k != 20)]
    missed, many = 0, 0
    for truth, percepts in drive(cars, 200, miss=0.2):
        missed += len(percepts["ego"].unseen)
        many += truth.n - 1
    assert missed / many == pytest.approx(0.2, abs=4 * math.sqrt(0.16 / many))
    first = [  # a new track is its first measurement
        of(percepts["ego"], "v1")["x"] - truth.x[truth.row["v1"]]
        for seed in range(400)
        for truth, percepts in drive([EGO, Car("v1", 50.0)], 1, seed, position_noise=0.5)
    ]
    assert np.mean(first) == pytest.approx(0.0, abs=0.1)
    assert np.std(first) == pytest.approx(0.5, rel=0.15)


def test_a_track_is_better_than_its_measurements() -> None:
    errors = []
    for seed in range(30):
        truth, percepts = last([EGO, Car("v", 50.0)], 20, seed, position_noise=1.0, speed_noise=0.3)
        errors.append(of(percepts["ego"], "v")["x"] - truth.x[truth.row["v"]])
    assert np.sqrt(np.mean(np.square(errors))) < 0.7


def test_latency_is_the_age_and_the_place_is_of_then() -> None:
    cars = [EGO, Car("v", 50.0, speed=15.0)]
    truth, percepts = last(cars, 12, latency=0.8)
    known = of(percepts["ego"], "v")
    assert known["age"] == pytest.approx(0.8)
    assert known["x"] == pytest.approx(truth.x[truth.row["v"]] - 0.8 * 15.0, abs=0.05)
    assert known["source"] == Source.SENSOR
    for how in ("cv", "lanes", "truth"):
        truth, percepts = last(cars, 12, latency=0.8, compensation=how)
        now = of(percepts["ego"], "v")
        assert now["x"] == pytest.approx(truth.x[truth.row["v"]], abs=0.05)
        assert now["lane_position"] == pytest.approx(truth.lane_position[truth.row["v"]], abs=0.05)
        assert now["age"] == pytest.approx(0.8)


def test_of_two_detections_a_track_is_confirmed() -> None:
    seen = [len(percepts["ego"].world.ids) for _, percepts in drive([EGO, Car("v", 50.0)], 4, confirm=3)]
    assert seen == [1, 1, 2, 2]


def late_error(how: str, accel: float) -> float:
    """m between where an AV takes a car to be and where it is, of one that changes its speed; 0.8 s late."""
    compensation = compensator(how, ROAD, Timing()) if how in PREDICTED else None
    perception = Perception(ROAD, Parameters(latency=0.8, compensation=how), Timing(), 1, compensation)
    cars = [EGO, Car("v", 40.0, speed=20.0, accel=accel)]
    for k in range(20):
        truth = snapshot(cars, k * FRAME)
        percepts = perception.perceive(truth)
    known = of(percepts["ego"], "v")
    assert known["age"] == pytest.approx(0.8)
    row = truth.row["v"]
    assert known["lane_position"] - known["x"] == pytest.approx(2.5, abs=0.1)
    return abs(known["x"] - float(truth.x[row])) + abs(known["y"] - float(truth.y[row]))


@pytest.mark.parametrize("accel", [-2.5, -1.5, 1.5])
def test_a_predictor_that_knows_speeds_compensates_better_than_constant_speed(accel: float) -> None:
    hold, lanes, gp, hpn = (late_error(how, accel) for how in ("hold", "lanes", "gp", "hpn"))
    assert lanes == pytest.approx(0.5 * abs(accel) * 0.8**2, rel=0.25)
    assert hold > 5.0 * lanes
    assert max(gp, hpn) < 0.7 * lanes


@pytest.mark.parametrize("how", PREDICTED)
def test_messages_that_come_when_they_come_are_predicted_to_now_all_the_same(how: str) -> None:
    level = Parameters(**MESSAGES, equipped=1.0, period=0.5, delay=0.3, jitter=0.1, compensation=how)
    perception = Perception(ROAD, level, Timing(), 1, compensator(how, ROAD, Timing()))
    cars, away = [EGO, Car("v", 50.0, speed=20.0), Car("w", 90.0, speed=20.0)], []
    for k in range(30):
        truth = snapshot(cars, k * FRAME)
        percept = perception.perceive(truth)["ego"]
        away += [percept.world.x[r] - truth.x[truth.row[i]] for i, r in percept.world.row.items()]
    assert len(away) > 60
    assert np.abs(away).max() < 0.3


def test_a_series_of_measurements_is_sampled_at_equal_intervals() -> None:
    time = np.array([[np.nan, 1.0, 1.0, 1.3, 1.6]])  # s: no new one in the third frame
    state, out = np.stack([10.0 * time, -time], 2), np.empty((1, 5, 2))
    kernels.resample(time, state, 0.2, out)
    assert out[0, :, 0] == pytest.approx([np.nan, 10.0, 12.0, 14.0, 16.0], nan_ok=True)
    assert out[0, :, 1] == pytest.approx([np.nan, -1.0, -1.2, -1.4, -1.6], nan_ok=True)


def test_who_is_no_av_any_more_is_heard_as_none() -> None:
    perception = Perception(ROAD, Parameters(mcm=True), Timing(), 1)
    cars = [EGO, Car("other", 40.0, kind=Kind.AV)]
    assert perception.perceive(snapshot(cars, 0.0))["ego"].hears == {"other"}
    percepts = perception.perceive(snapshot([EGO, Car("other", 40.0)], FRAME))
    assert set(percepts) == {"ego"}
    assert percepts["ego"].hears == frozenset()


# ---- tracks ----


def test_a_track_lives_on_without_measurements_and_ends_after_a_time() -> None:
    cars = [EGO, Car("v", 50.0, speed=10.0, leaves=2.0)]  # then it is gone
    known = {
        round(truth.time, 1): of(percepts["ego"], "v") if "v" in percepts["ego"].world.ids else None
        for truth, percepts in drive(cars, 20, forget=1.0, compensation="cv")
    }
    for time in (2.0, 2.4, 2.8):
        ghost = known[time]
        assert ghost is not None
        assert ghost["age"] == pytest.approx(time - 1.8)
        assert ghost["x"] == pytest.approx(50.0 + 10.0 * time, abs=0.05)
    assert known[3.0] is None
    assert known[3.8] is None


def test_a_turn_indicator_is_as_old_as_the_measurement() -> None:
    cars = [EGO, Car("v", 50.0, signals=1.0)]
    for truth, percepts in drive(cars, 12, latency=0.4):
        known = percepts["ego"].world
        if "v" in known.row:
            assert known.indicator[known.row["v"]] == (truth.time >= 1.4 - 1e-9)


def test_a_place_is_used_again_without_what_was_known_of_the_one_before() -> None:
    cars = [EGO, Car("a", 50.0, leaves=1.0), *(Car(f"b{k}", 20.0 + 9.0 * k) for k in range(90))]
    for truth, percepts in drive(cars, 12, forget=0.3):
        assert ("a" in percepts["ego"].world.ids) == (truth.time < 1.2)
        assert len(percepts["ego"].world.ids) == len({*truth.ids} | ({"a"} if truth.time < 1.2 else set()))


def test_along_a_lane_a_track_drives_round_the_bend() -> None:
    first = np.array([[0.0, 0.0], [100.0, 0.0]])
    angle = np.linspace(-math.pi / 2, 0.0, 40)
    bend = np.stack([100.0 + 50.0 * np.cos(angle), 50.0 + 50.0 * np.sin(angle)], 1)
    round_ = float(np.hypot(*np.diff(bend, axis=0).T).sum())
    road = RoadMap(
        (Lane("a_0", "a", 0, first, 100.0, 3.2, 20.0, (1,)), Lane("b_0", "b", 0, bend, round_, 3.2, 20.0))
    )
    truth = snapshot([EGO, Car("v", 92.5, speed=20.0, lane=0)], 0.0)
    truth = replace(truth, y=np.zeros(2), lane=np.zeros(2, np.int32))
    gone = replace(truth.only(np.array([truth.row["ego"]])), time=2.0)
    perception = Perception(road, Parameters(forget=5.0, compensation="lanes"), Timing(), 1)
    perception.perceive(truth)
    world = perception.perceive(gone)["ego"].world
    row, way = world.row["v"], 92.5 + 40.0 - 100.0  # m into the bend
    assert world.lane[row] == 1
    assert world.lane_position[row] == pytest.approx(way + 2.5, abs=0.01)
    assert world.heading[row] == pytest.approx(way / 50.0, abs=0.03)
    assert math.hypot(world.x[row] - 100.0, world.y[row] - 50.0) == pytest.approx(50.0, abs=0.1)


def test_noise_moves_nobody_over_the_line_where_it_stands() -> None:
    before, beyond = (np.array([[x, 0.0], [x + 100.0, 0.0]]) for x in (0.0, 100.0))
    lanes = Lane("a_0", "a", 0, before, 100.0, 3.2, 20.0, (1,)), Lane("b_0", "b", 0, beyond, 100.0, 3.2, 20.0)
    truth = snapshot([EGO, Car("v", 97.4, speed=0.0, lane=0)], 0.0)
    truth = replace(truth, y=np.zeros(2), lane=np.zeros(2, np.int32))
    perception = Perception(RoadMap(lanes), replace(levels()["v2v"], miss=0.0, loss=0.0), Timing(), 1)
    places = []
    for k in range(100):
        world = perception.perceive(replace(truth, time=k * FRAME))["ego"].world
        if "v" in world.row:
            row = world.row["v"]
            places.append((int(world.lane[row]), float(world.lane_position[row])))
    assert len(places) > 90
    assert {lane for lane, _ in places} == {0}
    assert 99.0 < float(np.mean([position for _, position in places])) < 100.0


# ---- messages ----


def test_a_message_of_age_a_shows_where_its_sender_was() -> None:
    cars = [EGO, Car("v", 50.0, speed=20.0, accel=-2.0)]
    ages = []
    for truth, percepts in drive(cars, 25, **MESSAGES, equipped=1.0, period=0.5, delay=0.33, jitter=0.1):
        if "v" not in percepts["ego"].world.ids:
            continue
        known = of(percepts["ego"], "v")
        then = truth.time - known["age"]
        assert known["source"] == Source.CAM
        assert known["x"] == pytest.approx(50.0 + 20.0 * then - then**2, abs=0.1)
        assert known["speed"] == pytest.approx(20.0 - 2.0 * then, abs=0.1)
        ages.append(known["age"])
    assert min(ages) >= 0.33
    assert len(ages) > 15
    assert max(ages) > 0.33 + 0.2  # between two messages it grows


def test_without_equipped_vehicles_there_are_no_messages() -> None:
    cars = [EGO, *(Car(f"v{k}", 20.0 * k + 20.0) for k in range(8))]
    _, percepts = last(cars, 10, **MESSAGES, cpm=True, equipped=0.0)
    assert percepts["ego"].world.ids == ("ego",)
    _, percepts = last(cars, 10, **MESSAGES, equipped=1.0)
    assert percepts["ego"].world.n == 9
    _, percepts = last(cars, 10, range=1.0, equipped=1.0)  # equipped, and the content switched off
    assert percepts["ego"].world.n == 1


def test_the_share_of_equipped_drivers_is_drawn_per_vehicle() -> None:
    cars = [EGO, *(Car(f"v{k}", 0.5 * k - 100.0, k % 3) for k in range(400))]
    _, percepts = last(cars, 6, **MESSAGES, equipped=0.3)
    assert (percepts["ego"].world.n - 1) / 400 == pytest.approx(0.3, abs=0.08)


def test_an_av_is_known_as_one_by_its_messages_alone() -> None:
    cars = [EGO, Car("other", 40.0, kind=Kind.AV)]
    for cam, kind in ((True, Kind.AV), (False, Kind.HV)):
        _, percepts = last(cars, 8, cam=cam)
        world = percepts["ego"].world
        assert world.kind[world.row["other"]] == kind
        assert world.kind[world.row["ego"]] == Kind.AV


def test_an_av_is_told_of_those_it_cannot_see() -> None:
    truck = Car("truck", 30.0, actor=Actor.TRUCK, length=12.0, width=2.5)
    cars = [EGO, truck, Car("hidden", 60.0), Car("helper", 80.0, 2, kind=Kind.AV)]
    how: dict[str, Any] = {"line_of_sight": True, "forget": 2.0}
    _, percepts = last(cars, 8, **how)
    assert "hidden" not in percepts["ego"].world.ids
    truth, percepts = last(cars, 8, **how, cpm=True, delay=0.3)
    known = of(percepts["ego"], "hidden")
    assert known["source"] == Source.CPM
    assert known["age"] >= 0.3
    then = truth.time - known["age"]
    assert known["x"] == pytest.approx(60.0 + 20.0 * then, abs=0.1)


def test_beyond_the_range_of_its_radio_nobody_is_heard() -> None:
    cars = [EGO, Car("near", 250.0), Car("far", 350.0)]
    _, percepts = last(cars, 8, **MESSAGES, equipped=1.0, message_range=300.0)
    assert percepts["ego"].world.ids == ("ego", "near")


@pytest.mark.parametrize(("loss", "burst"), [(0.1, 3.0), (0.4, 8.0), (0.5, 2.0)])
def test_losses_have_their_mean_and_their_mean_burst_length(loss: float, burst: float) -> None:
    stream = np.uint64(123456789)
    losses = np.array([kernels.lost(stream, k, loss, burst) for k in range(1000, 121_000)])
    assert losses.mean() == pytest.approx(loss, rel=0.08)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], losses.astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    assert runs.mean() == pytest.approx(burst, rel=0.08)


def test_intentions_are_heard_in_time_or_not_at_all() -> None:
    cars = [EGO, Car("other", 40.0, kind=Kind.AV), Car("human", 60.0)]
    _, percepts = last(cars, 4, mcm=True, delay=0.3)
    assert percepts["ego"].hears == {"other"}
    _, percepts = last(cars, 4, mcm=True, delay=0.5)  # later than the decision
    assert percepts["ego"].hears == frozenset()
    _, percepts = last(cars, 4, mcm=False)
    assert percepts["ego"].hears == frozenset()
    heard = [
        bool(percepts["ego"].hears)
        for _, percepts in drive(cars, 1500, mcm=True, loss=0.3, burst=2.0, period=0.2)
    ]
    assert np.mean(heard) == pytest.approx(0.7, abs=0.06)


# ---- draws ----


def test_draws_are_paired_whoever_else_is_there() -> None:
    level = {"miss": 0.3, "position_noise": 0.5, "cam": True, "equipped": 0.5, "loss": 0.3, "burst": 3.0}
    few = [EGO, Car("a", 40.0), Car("b", 60.0, 2)]
    more = [*few, Car("0", 10.0, 0, kind=Kind.AV), Car("z", -20.0)]
    for (_, one), (_, other) in zip(drive(few, 15, **level), drive(more, 15, **level), strict=True):
        for name in ("a", "b"):
            known = [name in percepts["ego"].world.ids for percepts in (one, other)]
            assert known[0] == known[1]
            if known[0]:
                assert of(one["ego"], name) == of(other["ego"], name)


def test_another_seed_draws_otherwise_and_the_same_one_alike() -> None:
    def places(seed: int) -> list[float]:
        _, percepts = last([EGO, Car("a", 40.0)], 3, seed, position_noise=0.5)
        return percepts["ego"].world.x.tolist()

    assert places(1) == places(1)
    assert places(1) != places(2)


# ---- what an AV observes ----


def test_rows_maps_ages_and_sources_are_the_percepts() -> None:
    config = ObservationConfig(frames=4)
    observer, ideal = Observer(ROAD, config), Observer(ROAD, config)
    cars = [EGO, Car("v", 30.0, speed=10.0), Car("far", 90.0)]
    for truth, percepts in drive(cars, 10, latency=0.8, range=70.0):
        observer.add(replace(truth, percepts=percepts))
        ideal.add(truth)
    edges = ("e",)
    now = observer.histories(lambda _: edges, lambda _: (None, 0))["ego"]
    then = ideal.histories(lambda _: edges, lambda _: (None, 0))["ego"]
    assert set(now.ids) - {""} == {"ego", "v"}
    row, known = now.ids.index("v"), then.ids.index("v")
    assert now.age[row] == pytest.approx(0.8)
    assert now.source[row] == Source.SENSOR
    assert now.age[0] == now.source[0] == 0.0
    late = then.kinematics[-1, known, 0] - now.kinematics[-1, row, 0]
    assert late == pytest.approx(0.8 * 10.0, abs=0.1)
    assert not np.array_equal(now.velocity_map, then.velocity_map)
    assert len(then.age) == 0  # ideal
    assert then.hears is None


# ---- as an option ----


def test_single_parameters_stand_behind_a_level() -> None:
    found = read("v2v,delay=0.8,cam=false")
    assert found is not None
    assert found.name == "v2v,cam=false,delay=0.8"
    assert found.parameters == replace(levels()["v2v"], delay=0.8, cam=False)
    assert read("ideal") is None
    assert read("ideal,range=1000") is None
    assert read("v2v") != read("harsh")


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("v2w", "--sensing='v2w': no such level, did you mean 'v2v'?"),
        ("v2v,dely=3", "--sensing.dely='3': unknown field, did you mean 'delay'?"),
        ("v2v,loss=0.9", "must be at least 10 where 0.9 of the messages are lost"),
        ("v2v,loss=x", "--sensing.loss='x': a number from 0 to 0.99 is needed"),
        ("v2v,loss", "PARAMETER=VALUE is needed"),
        ("v2v,compensation=guess", "must be one of hold, cv, lanes, gp, hpn, truth"),
    ],
)
def test_a_wrong_level_is_one_sentence(what: str, said: str) -> None:
    with pytest.raises(BadInput) as error:
        read(what)
    assert said in str(error.value)


def test_a_file_is_named_by_its_content(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("range: 50\nmiss: 0.1\n")
    text = asked("mine.yaml,delay=1", tmp_path)
    assert text == f"{tmp_path / 'mine.yaml'},delay=1"
    scenario = load("merge", sensing=text)
    assert scenario.sensing is not None
    assert scenario.sensing.parameters == Parameters(range=50.0, miss=0.1, delay=1.0)
    document = manifest(scenario, 3)
    assert document["sensing"] == {"name": scenario.sensing.name, "sha256": scenario.sensing.digest}
    assert scenario.sensing.name.startswith("mine-")
    assert "mine.yaml" in document["files"]
    (tmp_path / "wrong.yaml").write_text("rnge: 50\n")
    with pytest.raises(BadInput, match=r"wrong\.yaml.*rnge.*did you mean 'range'"):
        load("merge", sensing=str(tmp_path / "wrong.yaml"))


def test_ideal_sensing_is_called_as_before() -> None:
    plain = EpisodeOptions("merge", seed=7)
    assert "sensing" not in plain.document()
    assert plain.key == EpisodeOptions("merge", seed=7, sensing=None).key
    assert EpisodeOptions("merge", seed=7, sensing="v2v").cell != plain.cell
    assert load("merge").identity("idm", None, 45.0, 3).sensing is None
    assert load("merge", sensing="v2v,delay=1").identity("idm", None, 45.0, 3).sensing == "v2v,delay=1"
    assert "sensing" not in manifest(load("merge"), 3)


def test_a_message_about_a_vehicle_that_has_left_the_road_is_lost_when_nobody_tracks_it() -> None:
    cars = [EGO, Car("far", 400.0, kind=Kind.AV), Car("h", 470.0, speed=10.0, leaves=1.6)]
    cars.append(Car("z", -300.0, leaves=2.2))  # slots are freed when the vehicles on the road change
    late: dict[str, Any] = {"range": 60.0, "cpm": True, "cam": True, "delay": 2.0, "forget": 0.4}
    told = seen = 0
    for _, percepts in drive(cars, 30, **late, message_range=1000.0):
        for av, percept in percepts.items():
            ids = percept.world.ids
            assert av in ids
            assert len(set(ids)) == len(ids)
            assert set(ids) <= ({"ego", "far"} if av == "ego" else {"ego", "far", "h"})
            told += "far" in ids and av == "ego"
            seen += "h" in ids
    assert told > 0
    assert seen > 0
