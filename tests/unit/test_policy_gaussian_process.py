"""The bank of Gaussian processes: what it predicts, how sure it is, and that it is a Gaussian process."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct

from policy.prediction.gaussian_process import HEADING, SPEED, BankConfig, GaussianProcessBank
from policy.prediction.gp import GaussianProcessIndirect
from policy.prediction.kernel_prior import KernelPrior, PriorNetwork, describe

PAST = 0.2 * np.arange(-9, 1)  # s
AHEAD = 0.2 * np.arange(1, 21)  # s
PLAIN = BankConfig(1.0, (0.2, 1.0, 3.0), (0.5, 2.0), (1.0, 2.5), (0.02, 0.2))


def cars(speed: np.ndarray, heading: np.ndarray | None = None) -> np.ndarray:
    """[V,10,4] that end at the origin and came there with speeds [V,10] and headings [V,10] (0: east)."""
    state = np.zeros((*speed.shape, 4))
    state[:, :, 2] = speed
    if heading is not None:
        state[:, :, 3] = heading
    step = (
        0.2 * np.exp(1j * 0.5 * (state[:, 1:, 3] + state[:, :-1, 3])) * 0.5 * (speed[:, 1:] + speed[:, :-1])
    )
    place = np.concatenate([np.zeros((len(speed), 1)), np.cumsum(step, 1)], 1)
    state[:, :, 0], state[:, :, 1] = (place - place[:, -1:]).real, (place - place[:, -1:]).imag
    return state


def everywhere(state: np.ndarray) -> np.ndarray:
    return np.ones(state.shape[:2], bool)


def test_one_kernel_alone_is_what_scikit_learn_computes() -> None:
    bank = GaussianProcessBank(BankConfig(1.0, (0.7,), (1.3,), (1.0,), (0.1,)))
    rng = np.random.default_rng(0)
    series = 20.0 + rng.normal(0.0, 0.5, (3, 10)).cumsum(1)
    found = bank.forecast(series)
    kernel = ConstantKernel(0.7**2) * DotProduct(10.0 / 0.7) + ConstantKernel(1.3**2) * RBF(1.0)
    for k, values in enumerate(series):
        reference = GaussianProcessRegressor(kernel, alpha=0.1**2 + 1e-9, optimizer=None)
        reference.fit(PAST[:, None], values - values[-1])
        mean, deviation = reference.predict(AHEAD[:, None], return_std=True)
        np.testing.assert_allclose(found.mean[k], mean + values[-1], atol=1e-6)
        np.testing.assert_allclose(np.sqrt(found.variance[k]), deviation, atol=1e-6)
        likelihood = reference.log_marginal_likelihood(reference.kernel_.theta)
        assert bank.evidence((values - values[-1])[None])[0, 0] == pytest.approx(likelihood, abs=1e-6)


def test_a_drift_is_the_mean_function_of_scikit_learns_residuals() -> None:
    bank = GaussianProcessBank(BankConfig(1.0, (0.7,), (1.3,), (1.0,), (0.1,), (-2.0,)))
    values = 10.0 + np.random.default_rng(1).normal(0.0, 0.5, 10).cumsum()
    found = bank.forecast(values[None])
    kernel = ConstantKernel(0.7**2) * DotProduct(10.0 / 0.7) + ConstantKernel(1.3**2) * RBF(1.0)
    reference = GaussianProcessRegressor(kernel, alpha=0.1**2 + 1e-9, optimizer=None)
    reference.fit(PAST[:, None], values - values[-1] + 2.0 * PAST)
    mean = reference.predict(AHEAD[:, None]) - 2.0 * AHEAD + values[-1]
    np.testing.assert_allclose(found.mean[0], mean, atol=1e-6)
    path = np.concatenate([values[-1:], mean])
    np.testing.assert_allclose(found.integral[0], 0.1 * np.cumsum(path[1:] + path[:-1]), atol=1e-5)


def test_a_mixture_has_the_mean_and_spread_of_its_kernels_weighted_by_likelihood() -> None:
    both = GaussianProcessBank(BankConfig(1.0, (0.1, 3.0), (0.5,), (1.0,), (0.1,)))
    single = [GaussianProcessBank(BankConfig(1.0, (s,), (0.5,), (1.0,), (0.1,))) for s in (0.1, 3.0)]
    values = np.random.default_rng(2).normal(0.0, 0.4, (4, 10)).cumsum(1)
    log_prior, temperature = np.array([0.3, -0.2]), 2.0
    logit = both.evidence(values - values[:, -1:]) / temperature + log_prior
    weight = np.exp(logit) / np.exp(logit).sum(1, keepdims=True)
    parts = [bank.forecast(values) for bank in single]
    mean = sum(weight[:, k : k + 1] * parts[k].mean for k in range(2))
    second = sum(weight[:, k : k + 1] * (parts[k].variance + parts[k].mean ** 2) for k in range(2))
    found = both.forecast(values, log_prior, temperature)
    np.testing.assert_allclose(found.mean, mean, atol=1e-9)
    np.testing.assert_allclose(found.variance, second - mean**2, atol=1e-9)


def test_the_interval_grows_with_time_and_covers_cars_that_behave_as_assumed() -> None:
    rng = np.random.default_rng(1)
    times = np.concatenate([PAST, AHEAD])
    truth = 20.0 + rng.normal(0.0, 1.0, (400, 1)) * times + rng.normal(0.0, 0.02, (400, 30))
    found = GaussianProcessBank(PLAIN).forecast(truth[:, :10])
    std, along = np.sqrt(found.variance), np.sqrt(found.integral_variance)
    assert (np.diff(std.mean(0)) > 0.0).all()
    assert (np.diff(along.mean(0)) > 0.0).all()
    assert (np.abs(truth[:, 10:] - found.mean) < 1.645 * std).mean() > 0.85
    distance = 0.2 * np.cumsum(0.5 * (truth[:, 9:-1] + truth[:, 10:]), 1)
    assert (np.abs(distance - found.integral) < 1.645 * along).mean() > 0.85


def test_a_prior_over_kernels_moves_the_forecast() -> None:
    bank = GaussianProcessBank(BankConfig(1.0, (0.1, 3.0), (0.5,), (1.0,), (0.2,)))
    braking = (15.0 + 2.0 * PAST)[None]
    calm = bank.forecast(braking, np.array([50.0, -50.0]))
    lively = bank.forecast(braking, np.array([-50.0, 50.0]))
    assert calm.mean[0, -1] < lively.mean[0, -1]


def test_the_prior_in_numpy_is_the_one_that_was_fitted() -> None:
    config = GaussianProcessIndirect.prior_config()
    torch.manual_seed(0)
    network = PriorNetwork(config)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    state = cars(np.abs(np.random.default_rng(0).normal(10.0, 5.0, (6, 10))))
    motion = describe(state, np.ones(6, bool), 0.2)
    prior = KernelPrior.of(network)
    (speed, heading), spread = prior.apply(motion)
    raw = network(torch.from_numpy(motion.astype(np.float32))).detach().numpy()
    np.testing.assert_allclose(np.concatenate([speed, heading, np.log(spread)], 1), raw, atol=1e-5)
    assert speed.shape[1] == len(SPEED.kernels())
    assert heading.shape[1] == len(HEADING.kernels())
    np.testing.assert_allclose(prior.temperature, network.log_temperature.exp().detach().numpy(), rtol=1e-6)


def test_calibration_goes_with_time_not_with_frames() -> None:
    network = PriorNetwork(GaussianProcessIndirect.prior_config())
    network.calibration.copy_(torch.linspace(1.0, 2.0, 20).expand(10, 4, 20))
    prior = KernelPrior.of(network)
    np.testing.assert_allclose(prior.calibrated(20, 0.2)[9, 0], np.linspace(1.0, 2.0, 20))
    np.testing.assert_allclose(prior.calibrated(10, 0.4)[0, 3], np.linspace(1.0, 2.0, 20)[1::2])
    assert prior.calibrated(30, 0.2)[0, 0, 29] == 2.0


def test_fifty_vehicles_are_quick() -> None:
    rng = np.random.default_rng(0)
    state = cars(20.0 + rng.normal(0.0, 0.3, (50, 10)).cumsum(1))
    predictor, valid = GaussianProcessIndirect(), everywhere(state)
    predictor.predict(state, valid)
    spent = []
    for _ in range(30):
        began = time.perf_counter()
        predictor.predict(state, valid)
        spent.append(time.perf_counter() - began)
    assert min(spent) < 5e-3, "1 ms on an idle core (benchmarks); this only guards against a blunder"
