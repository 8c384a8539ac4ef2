"""The bank of Gaussian processes: what it predicts, how sure it is, and that it is a Gaussian process."""

from __future__ import annotations

import time

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct

from policy.gaussian_process import BankConfig, GaussianProcessBank

PAST = 0.2 * np.arange(-9, 1)  # s
AHEAD = 0.2 * np.arange(1, 21)  # s


def cars(speed: np.ndarray, heading: np.ndarray | None = None) -> np.ndarray:
    """[V,10,4] that drive east from the origin with speeds [V,10]."""
    state = np.zeros((*speed.shape, 4))
    state[:, :, 2] = speed
    if heading is not None:
        state[:, :, 3] = heading
    return state


def everywhere(state: np.ndarray) -> np.ndarray:
    return np.ones(state.shape[:2], bool)


def test_a_car_at_constant_speed_is_predicted_to_keep_it() -> None:
    state = cars(np.full((1, 10), 20.0))
    forecast = GaussianProcessBank().predict(state, everywhere(state))
    assert forecast.valid[0]
    np.testing.assert_allclose(forecast.speed[0], 20.0, atol=0.01)
    np.testing.assert_allclose(forecast.x[0], 20.0 * AHEAD, atol=0.05)
    np.testing.assert_allclose(forecast.y[0], 0.0, atol=1e-6)


def test_a_steady_acceleration_goes_on_and_braking_ends_at_standstill() -> None:
    state = cars(np.stack([20.0 + 1.5 * PAST, 3.0 - 3.0 * PAST]))
    forecast = GaussianProcessBank().predict(state, everywhere(state))
    assert forecast.speed[0, 4] == pytest.approx(21.5, abs=0.3)
    assert forecast.speed[1].min() == 0.0
    assert (np.diff(forecast.x[1]) >= -1e-9).all(), "nobody reverses"


def test_a_turning_car_is_predicted_on_an_arc() -> None:
    rate = 0.1  # rad/s
    state = cars(np.full((1, 10), 10.0), (rate * PAST)[None])
    forecast = GaussianProcessBank().predict(state, everywhere(state))
    assert forecast.heading[0, 4] == pytest.approx(0.1, abs=0.02)
    assert forecast.y[0, 4] == pytest.approx(0.5 * 10.0 * 0.1, abs=0.15)


def test_one_kernel_alone_is_what_scikit_learn_computes() -> None:
    bank = GaussianProcessBank(BankConfig(slope=(0.7,), amplitude=(1.3,), length=(1.0,), noise=(0.1,)))
    rng = np.random.default_rng(0)
    series = 20.0 + rng.normal(0.0, 0.5, (3, 10)).cumsum(1)
    found = bank.forecast_series(series, 10)
    kernel = ConstantKernel(0.7**2) * DotProduct(10.0 / 0.7) + ConstantKernel(1.3**2) * RBF(1.0)
    for k, values in enumerate(series):
        reference = GaussianProcessRegressor(kernel, alpha=0.1**2 + 1e-9, optimizer=None)
        reference.fit(PAST[:, None], values - values.mean())
        mean, deviation = reference.predict(AHEAD[:, None], return_std=True)
        np.testing.assert_allclose(found.mean[k], mean + values.mean(), atol=1e-6)
        np.testing.assert_allclose(np.sqrt(found.variance[k]), deviation, atol=1e-6)


def test_the_interval_grows_with_time_and_covers_cars_that_behave_as_assumed() -> None:
    rng = np.random.default_rng(1)
    times = np.concatenate([PAST, AHEAD])
    truth = 20.0 + rng.normal(0.0, 1.0, (400, 1)) * times + rng.normal(0.0, 0.02, (400, 30))
    state = cars(truth[:, :10])
    forecast = GaussianProcessBank().predict(state, everywhere(state))
    assert (np.diff(forecast.speed_std.mean(0)) > 0.0).all()
    assert (np.diff(forecast.along_std.mean(0)) > 0.0).all()
    inside = np.abs(truth[:, 10:] - forecast.speed) < 1.645 * forecast.speed_std
    assert inside.mean() > 0.85
    distance = 0.2 * np.cumsum(0.5 * (truth[:, 9:-1] + truth[:, 10:]), 1)
    assert (np.abs(distance - forecast.x) < 1.645 * forecast.along_std).mean() > 0.85


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_a_car_seen_for_a_moment_is_predicted_from_that_moment(frames: int) -> None:
    state = cars(np.full((1, 10), 15.0))
    valid = everywhere(state)
    valid[0, : 10 - frames] = False
    state[0, : 10 - frames] = 99.0  # what is not valid must not be read
    forecast = GaussianProcessBank().predict(state, valid)
    assert forecast.valid[0]
    assert forecast.speed[0, 19] == pytest.approx(15.0, abs=0.05)
    longer = GaussianProcessBank().predict(cars(np.full((1, 10), 15.0)), everywhere(state))
    assert forecast.speed_std[0, 9] > longer.speed_std[0, 9], "and it is known to be less certain"


def test_nan_rows_and_lost_cars_break_nothing() -> None:
    state = cars(np.full((4, 10), 15.0))
    valid = everywhere(state)
    state[1, 3, 2] = np.nan  # a gap: only what follows it counts
    state[2, 9] = np.nan  # nothing is known now
    valid[3, 9] = False  # out of sight now
    forecast = GaussianProcessBank().predict(state, valid)
    assert forecast.valid.tolist() == [True, True, False, False]
    for values in forecast[:-1]:
        assert np.isfinite(values).all()
    assert forecast.speed[1, 9] == pytest.approx(15.0, abs=0.05)


def test_a_standing_car_stays() -> None:
    state = cars(np.zeros((1, 10)))
    forecast = GaussianProcessBank().predict(state, everywhere(state))
    np.testing.assert_allclose(forecast.x, 0.0, atol=1e-6)


def test_a_prior_over_kernels_moves_the_forecast() -> None:
    config = BankConfig(slope=(0.1, 3.0), amplitude=(0.5,), length=(1.0,), noise=(0.2,))
    braking = cars((15.0 + 2.0 * PAST)[None])
    calm = GaussianProcessBank(config, log_prior=np.array([50.0, -50.0]))
    lively = GaussianProcessBank(config, log_prior=np.array([-50.0, 50.0]))
    valid = everywhere(braking)
    assert calm.predict(braking, valid).speed[0, -1] < lively.predict(braking, valid).speed[0, -1]
    with pytest.raises(ValueError, match="log_prior"):
        GaussianProcessBank(config, log_prior=np.zeros(3))


def test_fifty_vehicles_are_quick() -> None:
    rng = np.random.default_rng(0)
    state = cars(20.0 + rng.normal(0.0, 0.3, (50, 10)).cumsum(1))
    bank, valid = GaussianProcessBank(), everywhere(state)
    bank.predict(state, valid)
    spent = []
    for _ in range(30):
        began = time.perf_counter()
        bank.predict(state, valid)
        spent.append(time.perf_counter() - began)
    assert min(spent) < 5e-3, "1 ms on an idle core (benchmarks); this only guards against a blunder"
