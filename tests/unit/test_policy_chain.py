"""The prediction chain: it starts from maps rendered from predicted kinematics, seen from the future ego."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from policy_scenes import LANE_WIDTH, Car, histories, straight_road

from cosim.raster import rasterize_road
from cosim.types import COMPACT, KINEMATIC_FEATURES
from policy.chain import ChainConfig, Prediction, predict
from policy.hpn import HPN, HpnConfig
from policy.predictors import make_predictor
from policy.scene import Scene, join
from policy.tensors import to_batch

ROAD = straight_road(3)
CARS = [
    Car("ego", 300.0, 1, 20.0, is_av=True),
    Car("same", 330.0, 1, 20.0),
    Car("slow", 340.0, 2, 10.0),
    Car("ally", 280.0, 0, 20.0, is_av=True),
]


def chain(hpn: HPN | None, config: ChainConfig, cars: list[Car] = CARS) -> tuple[Scene, Prediction]:
    scene = join(histories(ROAD, cars))
    forecast = make_predictor("gp-indirect", config.horizon, 0.2).predict(scene.state, scene.valid)
    batch = to_batch(scene.histories, 0.0)
    with torch.inference_mode():
        return scene, predict(config, COMPACT, rasterize_road(ROAD), hpn, scene, batch, forecast)


def pixel(ahead: float, left: float) -> tuple[int, int]:
    """Row and column of a point in the ego's frame (m) on the compact map."""
    return int(16 - left / 1.0), int(64 + ahead / 2.0)


def test_untrained_it_returns_the_rendered_maps_step_after_step() -> None:
    torch.manual_seed(0)
    _, drawn = chain(None, ChainConfig(every=1))
    _, corrected = chain(HPN(HpnConfig()).eval(), ChainConfig(every=1))
    assert drawn.maps.shape == (2, 20, 4, 32, 128)
    torch.testing.assert_close(corrected.maps, drawn.maps, rtol=0.0, atol=1e-6)


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
    forecast = make_predictor("gp-indirect", 20, 0.2).predict(scene.state, scene.valid)
    batch = to_batch(scene.histories, 0.0)
    prediction = predict(ChainConfig(every=1), COMPACT, rasterize_road(ROAD), None, scene, batch, forecast)
    ego = scene.agents.index("ego")
    row, column = pixel(30.0, 0.0)
    assert (prediction.maps[ego, :, 1, row, column] == 0).all()


def test_a_paper_style_network_predicts_one_frame_at_a_time() -> None:
    torch.manual_seed(0)
    config = HpnConfig(block=1, correct=False, skips=False, reading="s2fc")
    _, prediction = chain(HPN(config).eval(), ChainConfig(horizon=6, every=1))
    assert prediction.maps.shape == (2, 6, 4, 32, 128)
    assert prediction.maps.min() >= 0.0
    assert prediction.maps.max() <= 1.0


def test_a_horizon_that_ends_within_a_block_is_cut() -> None:
    _, prediction = chain(HPN(HpnConfig()).eval(), ChainConfig(horizon=7, every=1))
    _, drawn = chain(None, ChainConfig(horizon=7, every=1))
    assert prediction.maps.shape[1] == 7
    torch.testing.assert_close(prediction.maps, drawn.maps, rtol=0.0, atol=1e-6)


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
