"""Fitting predictors: errors fall, intervals cover what they promise, and a killed fit goes on exactly."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from policy_scenes import braking_cars

from policy.prediction.gp import GaussianProcessIndirect
from policy.prediction.learned import KinematicNet, NetConfig
from policy.training.loop import LoopConfig
from policy.training.predictors import (
    FitConfig,
    PriorFit,
    examples_for_net,
    factors_for,
    fit,
    fresh_net,
    in_own_frame,
    net_loss,
)


def test_fitting_the_prior_lowers_the_error_and_calibration_gives_the_coverage_promised() -> None:
    past, future = braking_cars(0)
    windows = in_own_frame(past, future, np.ones(len(past)))
    prior = PriorFit(GaussianProcessIndirect)
    examples = prior.examples(windows)

    def error(predictor: GaussianProcessIndirect) -> float:
        f = predictor.predict(past, np.ones(past.shape[:2], bool))
        return float(np.hypot(f.x - future[:, :, 0], f.y - future[:, :, 1]).mean())

    before = error(prior.fitted())
    log = fit(prior.network, prior.loss, FitConfig(steps=60, batch=256), examples, examples)
    assert log[-1]["validation_loss"] < before
    assert error(prior.fitted()) < 0.6 * before
    fresh_past, fresh_future = braking_cars(1, 2000)
    f = prior.fitted().predict(fresh_past, np.ones(fresh_past.shape[:2], bool))
    miss = fresh_future[:, :, 2] - f.speed
    factor = factors_for((f.speed_std[:1000],), (miss[:1000],), np.ones(1000))
    assert (np.abs(miss[1000:]) <= 1.645 * factor * f.speed_std[1000:]).mean() == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("kind", ["lstm", "ae"])
def test_a_killed_fit_goes_on_to_the_same_weights(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    past, future = braking_cars(2, 200)
    examples = examples_for_net(in_own_frame(past, future, np.ones(len(past))))
    config = FitConfig(steps=30, batch=32, learning_rate=2e-3)

    def fresh() -> tuple[KinematicNet, Callable[..., list[dict[str, float]]]]:
        network = fresh_net(NetConfig(kind, "indirect"), 0)  # type: ignore[arg-type]
        return network, partial(fit, network, partial(net_loss, network), config, examples, examples)

    whole, fit_whole = fresh()
    untrained = float(net_loss(whole, examples).detach())
    assert fit_whole()[-1]["validation_loss"] < untrained
    monkeypatch.setattr("policy.training.predictors.LoopConfig", partial(LoopConfig, save_every=0.0))

    def killed(done: float, _: float) -> None:
        if done == 15:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fresh()[1](folder=tmp_path, progress=killed)
    again, fit_again = fresh()
    steps: list[float] = []
    fit_again(folder=tmp_path, progress=lambda done, _: steps.append(done))
    assert steps[0] == 16
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0.0, atol=0.0)
