"""VelocityMaps and kinematic rows, on the fake world and on drawn scenes."""

import numpy as np
import pytest

from cosim.episode import Observed
from cosim.geometry.raster import ROAD_LINE, ROAD_SURFACE, rasterize_road
from cosim.observation.observer import Observer
from cosim.simulation.fake import FakeSimulator, FakeVehicle, straight_road
from cosim.types import COMPACT, PAPER, History, Kind, ObservationConfig, Snapshot


def scene(**columns: list[float]) -> Snapshot:
    """A snapshot from a few columns; vehicle v0 is an AV at the origin."""
    n = len(columns["x"])
    full = {"y": [1.6] * n, "heading": [0.0] * n, "speed": [20.0] * n, "kind": [1] + [0] * (n - 1), **columns}
    return Snapshot(
        time=columns.get("time", [0.0])[0],
        ids=tuple(f"v{i}" for i in range(n)),
        kind=np.array(full["kind"], np.int8),
        mission=np.array(full.get("mission", [0] * n), np.bool_),
        x=np.array(full["x"], float),
        y=np.array(full["y"], float),
        heading=np.array(full["heading"], float),
        speed=np.array(full["speed"], float),
        accel=np.zeros(n),
        length=np.full(n, 5.0),
        width=np.full(n, 2.0),
        lane=np.array(full.get("lane", [0] * n), np.int32),
        lane_position=np.array(full["x"], float) + 2.5,
    )


def look(snapshot: Snapshot, config: ObservationConfig = COMPACT, ego: str = "v0") -> History:
    """What one AV sees after one frame."""
    observer = Observer(straight_road(3, 2000.0, 25.0), config)
    observer.add(snapshot)
    return observer.histories(lambda _: ("road",), lambda _: (None, 0))[ego]


def pixel(
    history: History, channel: int, ahead: float, left: float, config: ObservationConfig = COMPACT
) -> int:
    """The newest map's pixel at a place in the ego frame (m)."""
    u = int(np.floor(ahead / config.metres_along + config.width / 2))
    v = int(np.floor(config.height / 2 - left / config.metres_across))
    return int(history.velocity_map[-1, channel, v, u])


def value(dv: float) -> int:
    return round(255 * (0.1 + 0.9 * np.clip((dv + 30) / 60, 0, 1)))


@pytest.mark.parametrize("config", [COMPACT, PAPER])
def test_a_car_ahead_shines_with_its_relative_speed(config: ObservationConfig) -> None:
    history = look(scene(x=[500.0, 540.0], speed=[20.0, 26.0]), config)
    assert pixel(history, 1, 40.0, 0.2, config) == value(6.0)
    assert pixel(history, 0, 40.0, 0.2, config) == 0, "it is no AV"


def test_a_standing_car_keeps_a_floor_above_the_background() -> None:
    history = look(scene(x=[500.0, 520.0], speed=[40.0, 0.0]))
    assert pixel(history, 1, 20.0, 0.5) == value(-40.0) == 26


def test_other_avs_and_the_mission_vehicle_have_their_channels_and_the_ego_its_place() -> None:
    history = look(scene(x=[500.0, 470.0, 530.0], kind=[1, 1, 0], mission=[0, 0, 1]))
    assert pixel(history, 0, -30.0, 0.5) == value(0.0)
    assert pixel(history, 1, 30.0, 0.5) == value(0.0)
    assert pixel(history, 3, 30.0, 0.5) == value(0.0)
    assert pixel(history, 3, 0.5, 0.5) == value(0.0), "the ego is in the mission channel"
    assert pixel(history, 0, 0.5, 0.5) == 0, "but not among the other AVs"


def test_a_map_turns_with_its_ego() -> None:
    north = np.pi / 2
    history = look(scene(x=[500.0, 500.0], y=[0.0, 40.0], heading=[north, north]))
    assert pixel(history, 1, 40.0, 0.5) > 0
    assert pixel(history, 1, -40.0, 0.5) == 0


def test_a_car_in_mid_lane_change_is_a_rotated_box() -> None:
    turned = look(scene(x=[500.0, 530.0], heading=[0.0, 0.5]), PAPER).velocity_map[-1, 1]
    straight = look(scene(x=[500.0, 530.0], heading=[0.0, 0.0]), PAPER).velocity_map[-1, 1]
    assert abs(int((turned > 0).sum()) - int((straight > 0).sum())) <= 8, "the area stays 10 m2"
    rows = np.flatnonzero(turned.any(axis=1))
    assert len(rows) > len(np.flatnonzero(straight.any(axis=1)))


def test_a_car_outside_the_window_is_not_drawn_and_one_at_the_edge_is_cut() -> None:
    history = look(scene(x=[500.0, 640.0, 626.0]), ObservationConfig(perception_range=300.0))
    assert (history.velocity_map[-1, 1] > 0).sum() > 0
    assert (history.velocity_map[-1, 1][:, :64] > 0).sum() == 0


def test_the_road_shows_surface_and_lines() -> None:
    raster = rasterize_road(straight_road(2, 100.0, 25.0))
    column = raster.cells[:, 100]
    assert set(np.unique(column)) == {0, ROAD_SURFACE, ROAD_LINE}
    width = (column > 0).sum() * raster.cell
    assert width == pytest.approx(6.4, abs=1.0)


def test_any_number_of_channels() -> None:
    config = ObservationConfig(channels=("hv", "ego"))
    history = look(scene(x=[500.0, 520.0]), config)
    assert history.velocity_map.shape == (10, 2, 32, 128)
    assert pixel(history, 1, 0.5, 0.5) == value(0.0)


def test_rows_are_the_ego_then_the_nearest_in_the_ego_frame() -> None:
    history = look(
        scene(x=[500.0, 480.0, 510.0, 900.0], y=[1.6, 1.6, 4.8, 1.6], heading=[0.0, 0.0, 0.1, 0.0])
    )
    assert history.ids[:3] == ("v0", "v2", "v1")
    assert history.valid[-1].sum() == 3, "400 m away is out of sight"
    assert history.kinematics[-1, 1, :4] == pytest.approx([10.0, 3.2, 20.0, 0.1], abs=1e-5)
    assert not history.valid[:-1].any(), "there is no past yet"


def test_more_vehicles_than_rows_keeps_the_nearest() -> None:
    history = look(scene(x=[500.0] + [500.0 + 5 * k for k in range(20, 0, -1)]))
    distances = history.kinematics[-1, 1:, 0]
    assert distances == pytest.approx(np.arange(5.0, 80.0, 5.0))


def test_in_a_dense_queue_the_mission_vehicle_and_the_ego_s_own_leader_and_follower_keep_a_row() -> None:
    """16 cars in the next lane are nearer than any of the three."""
    beside = [500.0 + 4.0 * k for k in range(-8, 8)]
    queue = scene(
        x=[500.0, 560.0, 430.0, 610.0, 575.0, *beside],
        y=[1.6, 1.6, 1.6, 8.0, 1.6, *[4.8] * 16],
        lane=[0, 0, 0, 2, 0, *[1] * 16],
        mission=[0, 0, 0, 1, 0, *[0] * 16],
    )
    history = look(queue)
    assert history.ids[-3:] == ("v1", "v2", "v3"), "leader, follower, mission vehicle, by distance"
    assert history.valid[-1].all()
    distances = np.hypot(*history.kinematics[-1, :, :2].T)
    assert (np.diff(distances) >= 0.0).all()
    assert "v4" not in history.ids, "the leader's leader has no such right"
    assert set(history.ids[1:13]) <= {f"v{k}" for k in range(5, 21)}, "the nearest of the others"
    alone = look(queue, ObservationConfig(share_perception=False, perception_range=50.0))
    assert {"v1", "v2", "v3"}.isdisjoint(alone.ids), "nobody sees further than before"


def test_a_row_follows_its_vehicle_through_the_history() -> None:
    observer = Observer(straight_road(3, 2000.0, 25.0), COMPACT)
    for k in range(25):
        t = 0.2 * k
        observer.add(scene(x=[500.0 + 20 * t, 520.0 + 25 * t, 560.0 + 15 * t], time=[t]))
    history = observer.histories(lambda _: ("road",), lambda _: (22.0, 1))["v0"]
    row = history.ids.index("v1")
    x = history.kinematics[:, row, 0]
    assert np.diff(x) == pytest.approx(np.full(9, 5.0), abs=1e-4), "25 m/s in one fixed frame"
    assert history.valid[:, row].all()
    assert (history.target_speed, history.lane_changing) == (22.0, 1)


def test_headings_are_unwrapped_across_the_date_line_of_angles() -> None:
    observer = Observer(straight_road(3, 2000.0, 25.0), COMPACT)
    for k in range(10):
        angle = (np.pi - 0.25 + 0.05 * k + np.pi) % (2 * np.pi) - np.pi
        observer.add(scene(x=[500.0, 510.0], heading=[0.0, angle]))
    history = observer.histories(lambda _: ("road",), lambda _: (None, 0))["v0"]
    series = history.kinematics[:, 1, 3]
    assert np.diff(series) == pytest.approx(np.full(9, 0.05), abs=1e-5)


def test_perception_is_shared_between_avs_unless_switched_off() -> None:
    seen = scene(x=[500.0, 560.0, 600.0], kind=[1, 1, 0])
    alone = ObservationConfig(perception_range=70.0, share_perception=False)
    together = ObservationConfig(perception_range=70.0)
    assert "v2" not in look(seen, alone).ids
    assert "v2" in look(seen, together).ids


def test_a_history_is_a_view_that_survives_the_next_frames() -> None:
    simulator = FakeSimulator(
        [FakeVehicle("a", 100.0, 0, 20.0, is_av=True), FakeVehicle("b", 140.0, 0, 20.0)]
    )
    observer = Observer(simulator.road, COMPACT)
    for frame in simulator.reset(0):
        observer.add(frame)
    for _ in range(40):
        before = observer.histories(simulator.route, simulator.commanded)["a"]
        kept = before.velocity_map.copy()
        for frame in simulator.advance(())[1]:
            observer.add(frame)
        assert (before.velocity_map == kept).all()
        after = observer.histories(simulator.route, simulator.commanded)["a"]
        assert (after.velocity_map[:-2] == before.velocity_map[2:]).all()


def test_hundreds_of_vehicles_come_and_go() -> None:
    observer = Observer(straight_road(3, 2000.0, 25.0), ObservationConfig(height=16, metres_across=2.0))
    rng = np.random.default_rng(0)
    for _ in range(60):
        n = int(rng.integers(1, 150))
        kinds = [1, *rng.integers(0, 2, n - 1)]
        s = scene(x=list(rng.uniform(0, 2000, n)), kind=kinds)
        observer.add(s)
        histories = observer.histories(lambda _: ("road",), lambda _: (None, 0))
        assert len(histories) == int((s.kind == Kind.AV).sum())


def test_what_avs_observe_is_worked_out_once_and_not_after_the_simulation_went_on() -> None:
    looks: list[dict[str, History]] = []

    def now() -> dict[str, History]:
        looks.append({"v0": look(scene(x=[0.0], y=[0.0]))})
        return looks[-1]

    seen, unseen = Observed(now), Observed(now)
    assert not looks
    assert list(seen) == ["v0"]
    assert len(seen) == len(looks) == 1
    seen.expire()
    unseen.expire()
    assert seen["v0"] is looks[0]["v0"]
    with pytest.raises(RuntimeError, match="before the simulation went on"):
        len(unseen)
