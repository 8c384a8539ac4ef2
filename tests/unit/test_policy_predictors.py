"""The table of kinematic predictors: one protocol, the same care with what is not known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from policy_scenes import braking_cars, cars

from cosim.errors import BadInput, WeightsMismatch
from cosim.road import Lane, RoadMap
from policy.checkpoint import SHIPPED, save
from policy.prediction.forecast import integrate_position, motion_of
from policy.prediction.gp import GaussianProcessIndirect
from policy.prediction.kernel_prior import PriorNetwork, describe
from policy.prediction.lane import along_lanes
from policy.prediction.learned import KinematicNet, Learned, NetConfig
from policy.prediction.past import MAX_PAST_ACCEL, trailing_run, whole_past
from policy.prediction.predictors import PREDICTORS, make_predictor
from policy.training.predictors import (
    in_own_frame,
)

TIME = 0.2 * np.arange(-9, 1)


def everywhere(state: np.ndarray) -> np.ndarray:
    return np.ones(state.shape[:2], bool)


@pytest.mark.parametrize("name", PREDICTORS)
def test_a_steady_car_goes_on_whatever_else_is_not_known(name: str) -> None:
    predictor = make_predictor(name, 20, 0.2)
    state = cars(np.full((4, 10), 12.0))
    valid = everywhere(state)
    valid[1, :-1] = False  # entered the view just now
    state[1, :-1] = 1e6  # what is not valid must not be read
    valid[2, -1] = False  # left the view
    state[3, -1, 1] = np.nan
    forecast = predictor.predict(state, valid)
    assert predictor.name == name
    assert forecast.valid.tolist() == [True, True, False, False]
    for values in forecast[:-1]:
        assert values.shape == (4, 20)
        assert np.isfinite(values).all()
        assert (values[2:] == 0.0).all(), "no forecast of who is not known now"
    assert (forecast.speed >= 0.0).all()
    np.testing.assert_allclose(forecast.x[:2, 4], 112.0, atol=1.5)
    np.testing.assert_allclose(forecast.x[:2, -1], 148.0, atol=8.0)
    np.testing.assert_allclose(forecast.y[:2], 50.0, atol=1.0)


def test_without_prediction_every_car_stays_where_it_is() -> None:
    state = cars(np.full((2, 10), 12.0))
    valid = everywhere(state)
    valid[1, -1] = False  # left the view
    forecast = make_predictor("hold", 20, 0.2).predict(state, valid)
    assert forecast.valid.tolist() == [True, False]
    assert (forecast.x[0] == 100.0).all()
    assert (forecast.y[0] == 50.0).all()
    assert (forecast.speed == 0.0).all()
    assert (forecast.x[1] == 0.0).all(), "no forecast of a car that is not known now"


@pytest.mark.parametrize("name", PREDICTORS)
def test_a_standing_car_hardly_moves(name: str) -> None:
    state = cars(np.zeros((1, 10)), np.full((1, 10), 2.0))
    forecast = make_predictor(name, 20, 0.2).predict(state, everywhere(state))
    moved = np.hypot(forecast.x - 100.0, forecast.y - 50.0)
    assert moved[0, 4] < 0.5
    assert moved[0, -1] < 5.0, "it may start within four seconds"
    np.testing.assert_allclose(forecast.heading[0, 4], 2.0, atol=0.3)


@pytest.mark.parametrize("name", ["lstm-indirect", "gp-direct", "gp-indirect"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_turning_car_is_predicted_inside_the_turn(name: str, sign: float) -> None:
    state = cars(np.full((1, 10), 8.0), sign * 0.35 * TIME[None])
    forecast = make_predictor(name, 20, 0.2).predict(state, everywhere(state))
    aside = sign * (forecast.y[0, 4] - 50.0)
    assert 0.4 < aside < 3.0, "an arc is 1.4 m aside after 1 s"


@pytest.mark.parametrize("name", PREDICTORS)
def test_a_lane_change_under_way_breaks_nothing(name: str) -> None:
    drift = 0.08 * np.sin(np.pi * np.clip(TIME + 1.0, 0.0, 2.0) / 2.0)
    state = cars(np.full((1, 10), 20.0), drift[None])
    forecast = make_predictor(name, 20, 0.2).predict(state, everywhere(state))
    assert 50.2 < forecast.y[0, 4] < 54.0
    assert 116.0 < forecast.x[0, 4] < 122.0


@pytest.mark.parametrize("name", PREDICTORS)
def test_a_gap_in_the_past_hides_what_lies_before_it(name: str) -> None:
    state = cars(np.stack([np.full(10, 12.0)] * 2))
    state[1, :5] = 0.0  # would be a fierce acceleration
    state[1, 4] = np.nan
    short = everywhere(state)
    short[0, :5] = False
    forecast = make_predictor(name, 20, 0.2).predict(state, short)
    for values in forecast[:-1]:
        np.testing.assert_allclose(values[0], values[1], atol=1e-9)


@pytest.mark.parametrize("name", PREDICTORS)
def test_a_forecast_does_not_depend_on_place_direction_or_company(name: str) -> None:
    rng = np.random.default_rng(0)
    speed = np.maximum(10.0 + rng.normal(0.0, 0.4, (5, 10)).cumsum(1), 0.0)
    state = cars(speed, rng.normal(0.0, 0.02, (5, 10)).cumsum(1))
    turned = state.copy()
    c, s = np.cos(2.0), np.sin(2.0)
    turned[:, :, 0], turned[:, :, 1] = (
        c * state[:, :, 0] - s * state[:, :, 1],
        s * state[:, :, 0] + c * state[:, :, 1],
    )
    turned[:, :, 3] += 2.0
    predictor = make_predictor(name, 20, 0.2)
    a, b = predictor.predict(state, everywhere(state)), predictor.predict(turned, everywhere(state))
    np.testing.assert_allclose(b.x, c * a.x - s * a.y, atol=1e-3)
    np.testing.assert_allclose(b.y, s * a.x + c * a.y, atol=1e-3)
    np.testing.assert_allclose(a.along_std, b.along_std, atol=1e-3)
    alone = predictor.predict(state[2:3], everywhere(state[2:3]))
    np.testing.assert_allclose(alone.x[0], a.x[2], atol=1e-4)
    nobody = predictor.predict(state[:0], everywhere(state[:0]))
    assert nobody.x.shape == (0, 20)


def test_constant_acceleration_goes_on_accelerating_and_stops_at_standstill() -> None:
    state = cars(np.stack([10.0 + 2.0 * TIME, 2.0 - 2.0 * TIME]))
    forecast = make_predictor("ca", 20, 0.2).predict(state, everywhere(state))
    assert forecast.speed[0, 4] == pytest.approx(12.0, abs=1e-6)
    assert forecast.x[0, 4] == pytest.approx(111.0, abs=0.05)
    assert forecast.speed[1, -1] == 0.0


def test_the_gaussian_process_is_less_sure_of_a_braking_car_than_of_a_steady_one() -> None:
    state = cars(np.stack([np.full(10, 20.0), 14.0 - 3.0 * TIME]))
    forecast = make_predictor("gp-indirect", 20, 0.2).predict(state, everywhere(state))
    assert (forecast.along_std[1] > forecast.along_std[0]).all()
    assert (np.diff(forecast.along_std, axis=1) > 0.0).mean() > 0.9
    assert forecast.speed[1, 4] < 13.0, "braking goes on for a while"
    assert (np.diff(forecast.x[1]) >= -1e-9).all(), "nobody reverses"


def test_speed_and_heading_follow_from_positions() -> None:
    now = np.array([[0.0, 0.0, 5.0, 3.0]])
    speed = np.full((1, 20), 5.0)
    heading = 3.0 + 0.1 * np.arange(1, 21)[None]  # past pi
    x, y = integrate_position(now, speed, heading, 0.2)
    found_speed, found_heading = motion_of(now, x, y, 0.2)
    np.testing.assert_allclose(found_speed, 5.0, atol=0.02)
    np.testing.assert_allclose(found_heading, heading - 0.05, atol=1e-6)
    stopped = np.repeat(x[:, :1], 20, 1), np.repeat(y[:, :1], 20, 1)
    assert motion_of(now, *stopped, 0.2)[1][0, -1] == pytest.approx(3.05)


def test_an_unknown_past_went_as_the_oldest_known_frames_show() -> None:
    state = cars(np.stack([15.0 + 2.0 * TIME, np.full(10, 12.0), 14.0 - 8.0 * TIME, np.full(10, 9.0)]))
    state[1, :, 3] = 0.3 * TIME
    state[1] = cars(state[1:2, :, 2], state[1:2, :, 3])[0]
    valid = everywhere(state)
    valid[0, :7] = False
    state[1, :5] = np.nan
    valid[2, :6] = False
    valid[3, :-1] = False
    run = trailing_run(state, valid)
    assert run.tolist() == [3, 5, 4, 1]
    past = whole_past(state, run, 10, 0.2)
    np.testing.assert_allclose(past[0, :, 2], 15.0 + 2.0 * TIME)
    np.testing.assert_allclose(past[1, :, 3], 0.3 * TIME, atol=1e-9)
    whole = cars(np.full((1, 10), 12.0), 0.3 * TIME[None])[0]
    np.testing.assert_allclose(past[1, :, :2], whole[:, :2], atol=0.02)
    np.testing.assert_allclose(np.diff(past[2, :7, 2]), -MAX_PAST_ACCEL * 0.2, err_msg="no emergency for 2 s")
    np.testing.assert_allclose(past[3, :, 0], 100.0 + 9.0 * TIME)
    gone = whole_past(state[:1], np.zeros(1, np.int64), 10, 0.2)
    assert (gone == 0.0).all()
    longer = np.concatenate([state[:1], state[:1]], 1)
    np.testing.assert_allclose(whole_past(longer, np.full(1, 20), 10, 0.2), state[:1, :, :4])


@pytest.mark.parametrize("known", [1, 2, 4])
def test_an_interval_is_wider_the_less_is_known(known: int) -> None:
    state = cars(np.full((2, 10), 12.0))
    valid = everywhere(state)
    valid[1, :-known] = False
    forecast = make_predictor("gp-indirect", 20, 0.2).predict(state, valid)
    assert forecast.along_std[1].sum() > forecast.along_std[0].sum()


def test_what_is_described_is_the_present_motion() -> None:
    state = cars(np.stack([np.zeros(10), 15.0 + 2.0 * TIME, np.full(10, 9.0)]))
    motion = describe(state, np.array([True, True, False]), 0.2)
    assert motion[0, 2] == 1.0, "standing"
    np.testing.assert_allclose(motion[1, 4:12:2], np.tanh(1.0), err_msg="2 m/s2 over every lag")
    assert (motion[2] == 0.0).all(), "not known now"


def test_led_along_its_lane_a_car_takes_the_bend_that_its_past_does_not_show() -> None:
    bend = np.array([[0.0, 50.0], [110.0, 50.0], [110.0, 150.0]])
    road = RoadMap((Lane("e_0", "e", 0, bend, 210.0, 3.2, 13.9),))
    state = cars(np.full((3, 10), 10.0))[:, :, :4]
    state[2, :3] = np.nan  # a short history
    valid = np.isfinite(state[:, :, 0])
    plain = make_predictor("gp-indirect", 20, 0.2).predict(state, valid)
    lane = np.array([0, -1, 0])
    led = along_lanes(plain, state, valid, lane, np.full(3, 102.5), np.full(3, 5.0), road)
    assert plain.x[0, -1] == pytest.approx(140.0, abs=6.0)
    for car in (0, 2):
        assert led.x[car, -1] == pytest.approx(110.0, abs=2.0)
        assert led.y[car, -1] == pytest.approx(80.0, abs=6.0)
    np.testing.assert_allclose(led.x[1], plain.x[1], err_msg="off every lane: as forecast", atol=1e-6)
    np.testing.assert_allclose(led.speed, plain.speed, atol=0.5)


def test_windows_are_seen_from_the_vehicle_and_unknown_pasts_are_left_out() -> None:
    past, future = braking_cars(3, 5)
    c, s = np.cos(1.0), np.sin(1.0)
    for part in (past, future):
        x, y = part[:, :, 0].copy(), part[:, :, 1].copy()
        part[:, :, 0], part[:, :, 1] = c * x - s * y, s * x + c * y
        part[:, :, 3] += 1.0
    past[4, 0] = np.nan
    found = in_own_frame(past, future, np.array([1.0, 1.0, 2.0, 2.0, 9.0]))
    assert len(found.past) == 4
    np.testing.assert_allclose(found.past[:, -1, [0, 1, 3]], 0.0, atol=1e-12)
    assert (found.future[:, -1, 0] > 20.0).all()
    assert found.weight.mean() == pytest.approx(1.0)


# ---- names and weights ----


def test_an_unknown_predictor_is_bad_input() -> None:
    with pytest.raises(BadInput, match="predictor='psychic'"):
        make_predictor("psychic", 20, 0.2)


def test_a_horizon_that_a_network_was_not_made_for_is_bad_input() -> None:
    with pytest.raises(BadInput, match="20 frames of"):
        make_predictor("lstm-direct", 30, 0.2)
    assert make_predictor("ae-indirect", 5, 0.2).predict(
        cars(np.full((1, 10), 5.0)), np.ones((1, 10), bool)
    ).x.shape == (1, 5)


def test_weights_of_another_layout_are_refused(tmp_path: Path) -> None:
    other = NetConfig("ae", "direct", hidden=32)
    save(tmp_path / "x.safetensors", {"network": KinematicNet(other)}, {"network": other})
    with pytest.raises(WeightsMismatch, match="hidden"):
        Learned(NetConfig("ae", "direct"), weights=tmp_path / "x.safetensors")
    config = GaussianProcessIndirect.prior_config()
    save(tmp_path / "y.safetensors", {"prior": PriorNetwork(config)}, {"prior": config})
    assert GaussianProcessIndirect(weights=tmp_path / "y.safetensors").horizon == 20


@pytest.mark.parametrize("name", [n for n in PREDICTORS if (SHIPPED / f"{n}.safetensors").is_file()])
def test_shipped_weights_say_what_they_are(name: str) -> None:
    from policy.checkpoint import read_card

    card = read_card(SHIPPED / f"{name}.safetensors")
    assert 0.1 < card["measured"]["position_error_mean"] < 3.0
    assert max(card["data"]["training"]["seeds"]) < 100_000
    assert (
        100_000
        <= min(card["data"]["validation"]["seeds"])
        <= max(card["data"]["validation"]["seeds"])
        < 200_000
    )
