"""The HPN that ships, on small scenes: it predicts from what it sees: vehicles that stand, enter or turn."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from policy_scenes import LANE_WIDTH, Car, histories, straight_road

from cosim.errors import BadInput, WeightsMismatch
from cosim.geometry.raster import rasterize_road
from cosim.road import Lane, RoadMap
from cosim.types import COMPACT
from policy.chain.chain import ChainConfig, Prediction, predict
from policy.chain.map_error import MapPredictors
from policy.checkpoint import SHIPPED
from policy.inputs.scene import Scene, join
from policy.inputs.tensors import to_batch
from policy.networks.hpn import HPN
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import TrafficConfig, foresee
from policy.training import hpn as trained

ROAD = straight_road(3)
EGO = Car("ego", 300.0, 1, 20.0, is_av=True)
NAMES = [name for name in trained.VARIANTS if (SHIPPED / f"{name}.safetensors").is_file()]


def shipped(name: str = "hpn") -> HPN:
    variant, network = trained.load(SHIPPED / f"{name}.safetensors")
    assert variant == name
    return network


def ahead(cars: list[Car], road: RoadMap = ROAD, name: str = "hpn") -> tuple[Scene, Prediction]:
    """The whole horizon, frame by frame, as the HPN called `name` sees it."""
    scene = join(histories(road, cars))
    if name == "hpn-no-history":
        scene = scene.without_history()
    forecast = foresee(scene, make_predictor("gp-indirect", 20, 0.2), road, TrafficConfig())
    batch = to_batch(scene.histories)
    with torch.inference_mode():
        guess = predict(
            ChainConfig(every=1), COMPACT, rasterize_road(road), shipped(name), scene, batch, *forecast
        )
    return scene, guess


def row(scene: Scene, guess: Prediction, name: str) -> np.ndarray:
    """[M,8] of a vehicle in the ego's frame now."""
    history = scene.histories[scene.agents.index("ego")]
    return np.asarray(guess.rows[scene.agents.index("ego"), :, history.ids.index(name)])


def test_it_ships_and_what_it_is_stands_on_its_card() -> None:
    assert "hpn" in NAMES
    for name in NAMES:
        file = SHIPPED / f"{name}.safetensors"
        assert file.stat().st_size < 8e6
        card = json.loads(file.with_suffix(".json").read_text())
        assert card["data"]["train"]["seeds"][1] < 100_000 <= card["data"]["validation"]["seeds"][0]
        assert 0.0 < card["measured"]["validation_loss"] < 1.0


def test_weights_of_another_layout_are_refused(tmp_path: Path) -> None:
    for suffix in (".safetensors", ".json"):
        (tmp_path / f"hpn{suffix}").write_bytes((SHIPPED / f"hpn{suffix}").read_bytes())
    card = json.loads((tmp_path / "hpn.json").read_text())
    card["configs"]["hpn"]["kinematic"]["hidden"] = 64
    (tmp_path / "hpn.json").write_text(json.dumps(card))
    with pytest.raises(WeightsMismatch, match="kinematic"):
        trained.load(tmp_path / "hpn.safetensors")
    card["measured"]["variant"] = "other"
    (tmp_path / "hpn.json").write_text(json.dumps(card))
    with pytest.raises(BadInput, match="no HPN"):
        trained.load(tmp_path / "hpn.safetensors")


@pytest.mark.parametrize("name", NAMES)
def test_whatever_is_not_known_no_prediction_breaks(name: str) -> None:
    cars = [EGO, Car("new", 340.0, 1, 15.0, frames=1), Car("few", 280.0, 2, 25.0, frames=3)]
    given = histories(ROAD, [*cars, Car("gone", 330.0, 0, 20.0), Car("torn", 260.0, 0, 20.0)])
    for one, history in given.items():
        valid, kinematics = history.valid.copy(), history.kinematics.copy()
        valid[-1, history.ids.index("gone")] = False
        kinematics[4, history.ids.index("torn"), :3] = np.nan
        given[one] = history._replace(valid=valid, kinematics=kinematics)
    predictor = make_predictor("gp-indirect", 20, 0.2)
    guess = MapPredictors({name: shipped(name)}, predictor, COMPACT, ROAD).predict(given)
    maps = guess.maps[name]
    assert maps.shape == (1, 20, len(COMPACT.channels), COMPACT.height, COMPACT.width)
    assert np.isfinite(maps).all()
    assert (maps >= 0.0).all()
    assert (maps <= 1.0).all()


def test_a_standing_car_stays_and_a_steady_one_goes_on() -> None:
    scene, guess = ahead([EGO, Car("stands", 400.0, 0, 0.0), Car("goes", 350.0, 2, 20.0)])
    stands, goes = row(scene, guess, "stands"), row(scene, guess, "goes")
    assert abs(stands[-1, 0] - 100.0) < 8.0, "it may start within four seconds"
    assert abs(goes[-1, 0] - 130.0) < 12.0
    np.testing.assert_allclose(goes[:, 1], LANE_WIDTH, atol=0.8)


def test_a_car_that_just_entered_the_view_is_carried_on_and_one_out_of_it_is_not() -> None:
    scene, guess = ahead([EGO, Car("new", 350.0, 1, 20.0, frames=1)])
    assert abs(row(scene, guess, "new")[-1, 0] - 130.0) < 15.0
    humans = guess.maps[scene.agents.index("ego"), :, 1]
    assert (humans > 0.0).flatten(1).any(1).all(), "in every frame"
    _, alone = ahead([EGO])
    assert not (alone.maps[0, :, 1] > 0.0).any()


def test_who_changes_lanes_arrives_in_the_next_one() -> None:
    scene, guess = ahead([EGO, Car("over", 340.0, 0, 20.0, offset=0.6, drift=1.0)])
    beside = row(scene, guess, "over")[:, 1] + LANE_WIDTH  # of its lane's centre line
    assert beside[4] > 0.8
    assert abs(beside[-1] - LANE_WIDTH) < 1.0


def test_a_bend_is_driven_along_its_lane() -> None:
    turn = 30.0 * np.exp(1j * np.linspace(-np.pi / 2, 0.0, 20)) + 325.0 + 30.0j  # radius 30 m
    bend = np.array([[0.0, 0.0], *np.stack([turn.real, turn.imag], 1), [355.0, 300.0]])
    length = float(np.hypot(*np.diff(bend, axis=0).T).sum())
    road = RoadMap((Lane("a_0", "a", 0, bend, length, LANE_WIDTH, 13.9),))
    scene, guess = ahead([Car("ego", 280.0, 0, 10.0, is_av=True), Car("turns", 318.0, 0, 10.0)], road)
    turns = row(scene, guess, "turns")
    assert turns[-1, 1] > 5.0, "straight on there is no road"
