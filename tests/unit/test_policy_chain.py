"""The prediction chain: it starts from maps rendered from predicted kinematics, seen from the future ego."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from policy_scenes import LANE_WIDTH, Car, histories, straight_road

from cosim.geometry.raster import rasterize_road
from cosim.types import COMPACT, KINEMATIC_FEATURES
from policy.chain.chain import ChainConfig, Prediction, predict, shade
from policy.inputs.scene import Scene, join
from policy.inputs.tensors import to_batch, unit
from policy.networks.hpn import HPN, HpnConfig
from policy.networks.map_branch import MapBranchConfig
from policy.prediction.forecast import KinematicForecast
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import Traffic, TrafficConfig, foresee
from policy.prediction.vehicle_inputs import vehicle_inputs

ROAD = straight_road(3)
CARS = [
    Car("ego", 300.0, 1, 20.0, is_av=True),
    Car("same", 330.0, 1, 20.0),
    Car("slow", 340.0, 2, 10.0),
    Car("ally", 280.0, 0, 20.0, is_av=True),
]


CORRECTED = HpnConfig(maps="corrected", map_branch=MapBranchConfig(correct=True, skips=True))


def forecasts(scene: Scene, horizon: int = 20) -> tuple[KinematicForecast, Traffic]:
    return foresee(scene, make_predictor("gp-indirect", horizon, 0.2), ROAD, TrafficConfig())


def chain(hpn: HPN | None, config: ChainConfig, cars: list[Car] = CARS) -> tuple[Scene, Prediction]:
    scene = join(histories(ROAD, cars))
    forecast, traffic = forecasts(scene)
    batch = to_batch(scene.histories)
    with torch.inference_mode():
        return scene, predict(config, COMPACT, rasterize_road(ROAD), hpn, scene, batch, forecast, traffic)


def pixel(ahead: float, left: float) -> tuple[int, int]:
    """Row and column of a point in the ego's frame (m) on the compact map."""
    return int(16 - left / 1.0), int(64 + ahead / 2.0)


def test_untrained_it_returns_the_rendered_maps_step_after_step() -> None:
    torch.manual_seed(0)
    _, drawn = chain(HPN(HpnConfig()).eval(), ChainConfig(every=1))
    _, corrected = chain(HPN(CORRECTED).eval(), ChainConfig(every=1))
    assert drawn.maps.shape == (2, 20, 4, 32, 128)
    torch.testing.assert_close(corrected.maps, unit(drawn.maps), rtol=0.0, atol=1e-6)
    _, forecast = chain(None, ChainConfig(every=1))
    both = ((drawn.maps > 0) & (forecast.maps > 0)).sum() / ((drawn.maps > 0) | (forecast.maps > 0)).sum()
    assert both > 0.9, "on a straight road the forecast along the lane is the forecast"


def test_the_compact_chain_hands_on_one_hypothesis_a_second() -> None:
    _, every_frame = chain(None, ChainConfig(every=1))
    _, each_second = chain(None, ChainConfig())
    assert ChainConfig().hypotheses == 4
    torch.testing.assert_close(each_second.maps, every_frame.maps[:, 4::5])
    torch.testing.assert_close(each_second.kinematics, every_frame.kinematics[:, 4::5])
    assert each_second.rows.shape == (2, 20, 16, len(KINEMATIC_FEATURES))


def test_predicted_maps_move_with_the_predicted_ego() -> None:
    scene, prediction = chain(None, ChainConfig(every=1))
    ego = scene.agents.index("ego")
    hv = prediction.maps[ego, :, 1]
    for k in (0, 9, 19):
        row, column = pixel(30.0, 0.0)
        assert hv[k, row, column] > 0.0, "a car at the same speed stays where it is in the picture"
    row, column = pixel(40.0 - 10.0 * 4.0, LANE_WIDTH)
    assert hv[19, row, column] > 0.0, "a car 10 m/s slower has come 40 m closer after 4 s"
    assert hv[19, row, column] < hv[19, pixel(30.0, 0.0)[0], pixel(30.0, 0.0)[1]], "and looks slower"
    road = prediction.maps[ego, :, 2]
    assert (road[0] > 0).any()
    torch.testing.assert_close(road[0], road[19])  # the same straight road all the way


def test_kinematics_of_the_chain_are_the_gaussian_process_in_the_egos_present_frame() -> None:
    scene, prediction = chain(HPN(HpnConfig()).eval(), ChainConfig())
    ego = scene.agents.index("ego")
    history = scene.histories[ego]
    same = history.ids.index("same")
    assert prediction.rows[ego, 4, 0, 0] == pytest.approx(20.0, abs=0.1), "the ego itself after 1 s"
    assert prediction.rows[ego, 4, same, 0] == pytest.approx(50.0, abs=0.1)
    assert prediction.rows[ego, 4, same, 2] == pytest.approx(20.0, abs=0.05)
    empty = history.ids.index("")
    assert not prediction.valid[ego, empty]
    assert (prediction.kinematics[ego, :, empty] == 0).all()


def test_a_vehicle_out_of_sight_now_is_in_no_predicted_map() -> None:
    given = histories(ROAD, CARS)
    lost = {}
    for name, history in given.items():
        valid = history.valid.copy()
        valid[-1, history.ids.index("same")] = False
        lost[name] = history._replace(valid=valid)
    scene = join(lost)
    forecast, traffic = forecasts(scene)
    batch = to_batch(scene.histories)
    row, column = pixel(30.0, 0.0)
    ego = scene.agents.index("ego")
    for hpn in (None, HPN(HpnConfig()).eval()):
        with torch.inference_mode():
            prediction = predict(
                ChainConfig(every=1), COMPACT, rasterize_road(ROAD), hpn, scene, batch, forecast, traffic
            )
        assert (prediction.maps[ego, :, 1, row, column] == 0).all()


def test_a_paper_style_network_predicts_one_frame_at_a_time() -> None:
    torch.manual_seed(0)
    config = HpnConfig(maps="plain", map_branch=MapBranchConfig(block=1, reading="s2fc"))
    _, prediction = chain(HPN(config).eval(), ChainConfig(horizon=6, every=1))
    assert prediction.maps.shape == (2, 6, 4, 32, 128)
    assert prediction.maps.min() >= 0.0
    assert prediction.maps.max() <= 1.0


def test_a_horizon_that_ends_within_a_block_is_cut() -> None:
    torch.manual_seed(0)
    _, prediction = chain(HPN(CORRECTED).eval(), ChainConfig(horizon=7, every=1))
    _, drawn = chain(HPN(HpnConfig()).eval(), ChainConfig(horizon=7, every=1))
    assert prediction.maps.shape[1] == 7
    torch.testing.assert_close(prediction.maps, unit(drawn.maps), rtol=0.0, atol=1e-6)


def test_what_avs_share_is_known_once_and_alone_each_knows_its_own() -> None:
    far = [dataclasses.replace(CARS[0], x=300.0), dataclasses.replace(CARS[3], x=360.0), *CARS[1:3]]
    given = histories(ROAD, far)
    together, alone = join(given, share=True), join(given, share=False)
    assert sorted(together.vehicles) == ["ally", "ego", "same", "slow"]
    assert len(alone.vehicles) == 8
    for scene in (together, alone):
        for b, history in enumerate(scene.histories):
            for r, name in enumerate(history.ids):
                if name:
                    assert scene.vehicles[scene.row[b, r]] == name
            np.testing.assert_allclose(scene.state[scene.ego[b], -1, :2], history.pose[:2], atol=1e-3)


def test_every_vehicle_that_an_ally_sees_is_in_the_predicted_map_but_alone_only_the_own_rows() -> None:
    crowd = [Car(f"c{k}", 250.0 + 9.0 * k, k % 3, 20.0) for k in range(24)]
    given = histories(ROAD, [*CARS[:3], dataclasses.replace(CARS[3], x=400.0), *crowd])
    drawn = {}
    for share in (True, False):
        scene = join(given, share)
        forecast, traffic = forecasts(scene)
        batch = to_batch(scene.histories)
        one = ChainConfig(horizon=1, every=1)
        maps = predict(one, COMPACT, rasterize_road(ROAD), None, scene, batch, forecast, traffic).maps
        drawn[share] = int((maps[scene.agents.index("ego"), 0, 1] > 0).sum())
    assert drawn[True] > 1.2 * drawn[False], "15 rows are not all that is known"


def test_a_vehicle_whose_place_is_doubtful_is_drawn_darker_but_never_vanishes() -> None:
    rows = np.zeros((1, 1, 3, 8))
    rows[0, 0, :, 2] = 20.0, 20.0, 35.0  # m/s: as fast as the ego: pixel 0.55; 15 m/s faster: 0.775
    share = np.array([[[1.0, 0.5, 0.0]]])
    speed = shade(rows, share)[0, 0, :, 2]
    pixel_value = 0.1 + 0.9 * (speed - 20.0 + 30.0) / 60.0
    assert pixel_value == pytest.approx([0.55, 0.275, 0.1])


def test_the_kinematic_branch_sees_a_scene_from_each_vehicle_and_nothing_of_the_unknown() -> None:
    slow = [*CARS, Car("next", 345.0, 1, 12.0, accel=-2.0), Car("new", 420.0, 2, 20.0, frames=3)]
    scene = join(histories(ROAD, slow))
    inputs = vehicle_inputs(scene, *forecasts(scene))
    own = dict(zip(scene.vehicles, inputs.own, strict=True))
    leader = slice(-10, -5)  # there, gap, speed, closing, acceleration of the next one ahead
    assert own["same"][leader][0] == 1.0, "`next` is ahead of `same` on its lane"
    assert own["same"][leader][1] == pytest.approx(np.exp(-10.0 / 20.0), abs=1e-3), (
        "10 m from bumper to bumper"
    )
    assert own["same"][leader][3] == pytest.approx((20.0 - 12.0) / 8.0)
    assert own["same"][leader][4] == pytest.approx(-2.0 / 4.0, abs=1e-5)
    assert own["next"][leader][0] == 0.0, "nobody ahead on its lane"
    assert np.isfinite(inputs.own).all()
    at = scene.vehicles.index("ally")
    moved = Car("ally", 80.0, 0, 20.0, is_av=True)  # the same picture, 200 m further back
    elsewhere = join(
        histories(ROAD, [moved, *(dataclasses.replace(c, x=c.x - 200.0) for c in slow if c.name != "ally")])
    )
    np.testing.assert_allclose(
        vehicle_inputs(elsewhere, *forecasts(elsewhere)).own[at], inputs.own[at], atol=1e-4
    )
    blind = vehicle_inputs(scene.without_history(), *forecasts(scene.without_history()))
    past = slice(11, 47)
    assert (blind.own[:, past] == 0.0).all(), "without history nothing of the past is left"
    assert (inputs.own[:, past] != 0.0).any()


def test_nan_and_short_histories_and_vehicles_off_every_lane_break_no_prediction() -> None:
    given = histories(ROAD, [*CARS, Car("late", 310.0, 2, 15.0, frames=1)])
    broken = {}
    for name, history in given.items():
        kinematics, lane = history.kinematics.copy(), history.lane.copy()
        kinematics[3, history.ids.index("same"), 2] = np.nan
        kinematics[-1, history.ids.index("slow"), 0] = np.nan
        lane[history.ids.index("late")] = -1
        broken[name] = history._replace(kinematics=kinematics, lane=lane)
    scene = join(broken)
    torch.manual_seed(0)
    hpn = HPN(HpnConfig()).eval()
    assert hpn.kinematic is not None
    torch.nn.init.normal_(hpn.kinematic.out.weight, std=0.1)
    batch = to_batch(scene.histories)
    with torch.inference_mode():
        ahead = predict(ChainConfig(), COMPACT, rasterize_road(ROAD), hpn, scene, batch, *forecasts(scene))
    assert torch.isfinite(ahead.maps).all()
    assert torch.isfinite(ahead.kinematics).all()
    assert (ahead.maps[:, :, 1] > 0).any()


def test_the_kinematic_branch_asks_for_the_traffic() -> None:
    scene = join(histories(ROAD, CARS))
    forecast, _ = forecasts(scene)
    with pytest.raises(ValueError, match="traffic"):
        predict(
            ChainConfig(),
            COMPACT,
            rasterize_road(ROAD),
            HPN(HpnConfig()).eval(),
            scene,
            to_batch(scene.histories),
            forecast,
        )
