"""Training of the HPN: what the losses say, that a killed run goes on exactly, what a run refuses."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from policy_scenes import Car, histories, straight_road

from cosim.errors import BadInput
from cosim.types import COMPACT, Snapshot
from policy.chain.map_error import picture_error, vehicle_channels
from policy.networks.kinematic_branch import OUTPUTS, KinematicConfig
from policy.networks.map_branch import MapBranchConfig
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import TrafficConfig
from policy.training import hpn
from policy.training.kinematics import KinematicTask, KinematicTraining, collate, losses
from policy.training.loop import LoopConfig, one_cycle, train
from policy.training.map_branch import MapTask, MapTraining
from policy.training.moments import MapSample, Moment, map_sample, moment, states_of

ROAD = straight_road(3)
CARS = [
    Car("ego", 300.0, 1, 20.0, is_av=True),
    Car("same", 330.0, 1, 20.0, accel=-1.0),
    Car("slow", 340.0, 2, 10.0),
    Car("ally", 280.0, 0, 20.0, is_av=True),
]


def snapshots(cars: list[Car] = CARS, frames: int = 20) -> list[Snapshot]:
    """What follows: everybody goes on as before."""
    cars = sorted(cars, key=lambda c: c.name)
    out = []
    for k in range(1, frames + 1):
        t = 0.2 * k
        array = np.array(
            [[c.x + c.speed * t + 0.5 * c.accel * t**2, c.y, c.speed + c.accel * t] for c in cars]
        )
        flat = np.zeros(len(cars))
        out.append(
            Snapshot(
                t,
                tuple(c.name for c in cars),
                np.array([c.is_av for c in cars], np.int8),
                np.zeros(len(cars), bool),
                array[:, 0],
                array[:, 1],
                flat,
                array[:, 2],
                flat,
                flat + 5.0,
                flat + 2.0,
                np.zeros(len(cars), np.int32),
                flat,
            )
        )
    return out


def a_moment(cars: list[Car] = CARS) -> Moment:
    predictor = make_predictor("gp-indirect", 20, 0.2)
    return moment(histories(ROAD, cars), snapshots(cars), ROAD, predictor, TrafficConfig())


def moments(count: int) -> list[Moment]:
    rng = np.random.default_rng(3)
    out = []
    for _ in range(count):
        cars = [
            Car(f"c{k}", 200.0 + 40.0 * k, int(rng.integers(3)), float(rng.uniform(10, 25)), is_av=k % 3 == 0,
                accel=float(rng.uniform(-1.5, 1.5)))
            for k in range(6)
        ]  # fmt: skip
        out.append(a_moment(cars))
    return out


def samples(count: int) -> list[MapSample]:
    rng = np.random.default_rng(4)
    history = histories(ROAD, CARS)["ego"]
    out = []
    for _ in range(count):
        maps = (rng.random((20, 4, 32, 128)) > 0.98).astype(np.uint8) * 140
        out.append(map_sample(history._replace(velocity_map=maps[:10]), maps, snapshots()))
    return out


def kinematic_task(updates: int = 12) -> KinematicTask:
    found = moments(6)
    return KinematicTask(KinematicConfig(), KinematicTraining(batch=3), updates, found, found[:2])


def test_a_moment_knows_where_everybody_really_went() -> None:
    now = a_moment()
    names = ["ally", "ego", "same", "slow"]
    order = np.argsort(np.argsort(names))
    assert now.known.all()
    assert now.truth.shape == (4, 20, 4)
    speeds = sorted(now.truth[:, -1, 2].tolist())
    assert speeds == pytest.approx([10.0, 16.0, 20.0, 20.0], abs=1e-4)
    assert len(order) == 4
    gap = np.hypot(*(now.truth[:, 0, :2] - now.lane[:, 0, :2]).T)
    assert (gap < 0.1).all(), "0.2 s ahead every forecast is right"
    assert np.abs(now.truth[..., :2]).max() < 300.0, "small numbers: float32 has seven digits"


def test_who_leaves_the_road_has_no_truth_and_costs_nothing() -> None:
    short = snapshots()
    for k in range(10, 20):
        short[k] = snapshots([c for c in CARS if c.name != "slow"], k + 1)[k]
    truth = states_of(("slow", "ego"), short)
    assert np.isnan(truth[0, 10:]).all()
    assert np.isfinite(truth[1]).all()
    predictor = make_predictor("gp-indirect", 20, 0.2)
    batch = collate([moment(histories(ROAD, CARS), short, ROAD, predictor, TrafficConfig())])
    raw = torch.zeros(4, 20, OUTPUTS, requires_grad=True)
    found = losses(raw, batch, KinematicTraining())
    found["loss"].backward()
    assert torch.isfinite(found["loss"])
    assert raw.grad is not None
    assert torch.isfinite(raw.grad).all()


def test_the_right_correction_costs_less_than_none_and_the_picture_hides_a_shared_shift() -> None:
    batch = collate([a_moment()])
    config = KinematicTraining()
    none = losses(torch.zeros(4, 20, OUTPUTS), batch, config)
    raw = torch.zeros(4, 20, OUTPUTS)
    raw[..., 0] = -30.0  # believe the lane
    raw[..., 1] = batch.truth[..., 0] - batch.lane[..., 0]  # everybody drives due east
    raw[..., 2] = batch.truth[..., 1] - batch.lane[..., 1]
    raw[..., 3] = batch.truth[..., 2] - batch.lane[..., 2]
    raw[..., 4] = batch.truth[..., 3] - batch.lane[..., 3]
    right = losses(raw, batch, config)
    assert right["picture"] < 1e-4
    assert right["alone"] < 1e-4
    assert right["picture"] < 0.2 * none["picture"]
    raw[..., 1] += 3.0
    shifted = losses(raw, batch, config)
    assert shifted["picture"] < 1e-4, "in the picture only what is relative to the ego can be seen"
    assert shifted["alone"] > 0.3


@pytest.mark.parametrize("kind", ["kinematic", "plain"])
def test_a_killed_run_goes_on_as_if_nothing_had_happened(kind: str, tmp_path: Path) -> None:
    def task() -> KinematicTask | MapTask:
        if kind == "kinematic":
            return kinematic_task()
        found = samples(4)
        return MapTask(MapBranchConfig(), MapTraining(batch=2), 6, found, found[:1])

    updates = 12 if kind == "kinematic" else 6
    config = LoopConfig(updates=updates, log_every=4, validate_every=6, save_every=0.0)
    whole = train(task(), config, tmp_path / "whole", layout={})

    def kill(done: float, _: float) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(task(), config, tmp_path / "two", layout={}, progress=kill)
    again = train(task(), config, tmp_path / "two", layout={}, resume=True)
    assert again == whole, "losses are equal to the last digit"
    with (tmp_path / "two" / "log.csv").open(newline="") as file:
        assert [row["update"] for row in csv.DictReader(file)] == [f"{line['update']:g}" for line in whole]
    assert list((tmp_path / "two" / "tensorboard").glob("events.*"))


def test_a_folder_with_another_run_is_refused(tmp_path: Path) -> None:
    config = LoopConfig(updates=1, log_every=1, validate_every=1)
    train(kinematic_task(1), config, tmp_path, layout={"seed": 0})
    with pytest.raises(BadInput, match="--resume"):
        train(kinematic_task(1), config, tmp_path, layout={"seed": 0})
    with pytest.raises(BadInput, match=r"another one \(seed differ\)"):
        train(kinematic_task(1), config, tmp_path, layout={"seed": 1}, resume=True)
    (tmp_path / "state.safetensors").write_bytes(b"no")
    with pytest.raises(BadInput, match="not the state"):
        train(kinematic_task(1), config, tmp_path, layout={"seed": 0}, resume=True)


def test_the_learning_rate_goes_up_and_then_down_to_nothing() -> None:
    rates = [one_cycle(k, 100, 1.0) for k in range(100)]
    assert max(rates) == pytest.approx(1.0)
    assert rates.index(max(rates)) == 30
    assert rates[0] < 0.1
    assert rates[-1] < 0.01


def test_weights_are_saved_with_what_they_are_and_load_as_that(tmp_path: Path) -> None:
    task = kinematic_task(2)
    log = train(task, LoopConfig(updates=2, log_every=1, validate_every=1), tmp_path, layout={})
    path = tmp_path / "hpn.safetensors"
    hpn.save(path, "hpn", hpn.assemble("hpn", task), log[-1], {"episodes": 6})
    name, network = hpn.load(path)
    assert name == "hpn"
    assert network.kinematic is not None
    for key, value in task.network.state_dict().items():
        assert torch.equal(network.kinematic.state_dict()[key], value)


def test_pre_and_iou_are_what_the_contract_says() -> None:
    channels = vehicle_channels(COMPACT)
    assert channels.tolist() == [0, 1, 3], "the road is no vehicle"
    true = np.zeros((4, 32, 128), np.uint8)
    true[1, 10:12, 20:23] = 255
    true[2] = 128
    guess = np.zeros_like(true)
    guess[1, 10:12, 21:24] = 255  # one pixel further on
    pre, iou = picture_error(guess, true, channels)
    assert pre == pytest.approx(4.0 / (3 * 32 * 128)), "two pixels too many, two missed"
    assert iou == pytest.approx(4.0 / 8.0)
    assert picture_error(true, true, channels) == (0.0, 1.0)
    faint = np.where(true[1] > 0, 0.04, 0.0).astype(np.float32)
    assert picture_error(np.stack([faint] * 4), true, channels)[1] == 0.0, "0.05 is the threshold"
