"""The table of kinematic predictors: one protocol, the same care with what is not known."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.errors import BadInput
from policy.predictors import PREDICTORS, make_predictor

PAST = 0.2 * np.arange(-9, 1)


@pytest.mark.parametrize("name", PREDICTORS)
def test_every_predictor_keeps_the_protocol(name: str) -> None:
    predictor = make_predictor(name, 20, 0.2)
    state = np.zeros((3, 10, 8))
    state[:, :, 2] = 12.0
    valid = np.ones((3, 10), bool)
    valid[1, :-1] = False
    valid[2, -1] = False
    state[2, -1] = np.nan
    forecast = predictor.predict(state, valid)
    assert predictor.name == name
    assert forecast.valid.tolist() == [True, True, False]
    for values in forecast[:-1]:
        assert values.shape == (3, 20)
        assert np.isfinite(values).all()
    np.testing.assert_allclose(forecast.x[:2, -1], 48.0, atol=0.5)


def test_constant_acceleration_goes_on_accelerating_and_stops_at_standstill() -> None:
    state = np.zeros((2, 10, 8))
    state[0, :, 2] = 10.0 + 2.0 * PAST
    state[1, :, 2] = 2.0 - 2.0 * PAST
    forecast = make_predictor("ca", 20, 0.2).predict(state, np.ones((2, 10), bool))
    assert forecast.speed[0, 4] == pytest.approx(12.0, abs=1e-6)
    assert forecast.x[0, 4] == pytest.approx(11.0, abs=0.05)
    assert forecast.speed[1, -1] == 0.0


def test_an_unknown_predictor_is_bad_input() -> None:
    with pytest.raises(BadInput, match="predictor='psychic'"):
        make_predictor("psychic", 20, 0.2)
