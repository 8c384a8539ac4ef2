"""The HPN learns who brakes behind a slower one, and how little is known of those who do as they like."""

from __future__ import annotations

import numpy as np
import torch

from policy.networks.kinematic_branch import KinematicBranch, KinematicConfig, confidence, correct
from policy.prediction.vehicle_inputs import NEIGHBOUR_INPUTS, NEIGHBOURS, own_inputs
from policy.training.kinematics import KinematicTask, KinematicTraining, collate
from policy.training.moments import Moment

torch.set_num_threads(1)
CLOSING, WILD = 0, 1  # two of a vehicle's own inputs
TIME = 0.2 * np.arange(1, 21)


def moments(count: int, seed: int) -> list[Moment]:
    """Eight vehicles in a row; vehicle 0 is the AV that looks. Who closes in brakes; the wild ones do
    anything."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        own = np.zeros((8, own_inputs(10)), np.float32)
        own[1:, CLOSING] = rng.random(7) < 0.5
        own[4:, WILD] = 1.0
        brake = 1.5 * own[:, CLOSING] + own[:, WILD] * rng.normal(0.0, 4.0, 8)
        lane = np.zeros((8, 20, 4), np.float32)
        lane[..., 0] = 15.0 * np.arange(8)[:, None] + 10.0 * TIME
        lane[..., 2] = 10.0
        truth = lane.copy()
        truth[..., 0] -= 0.5 * brake[:, None] * TIME**2
        truth[..., 2] -= brake[:, None] * TIME
        near = np.zeros((8, NEIGHBOURS, NEIGHBOUR_INPUTS), np.float32)
        out.append(Moment(own, near, lane, lane, truth, np.ones(8, bool), np.array([0])))
    return out


def trained(updates: int) -> KinematicBranch:
    task = KinematicTask(
        KinematicConfig(hidden=32, neighbour=8),
        KinematicTraining(batch=8, rate=5e-3),
        updates,
        moments(64, 0),
        moments(16, 1),
    )
    for number in range(updates):
        task.update(number)
    return task.network


def test_it_learns_who_brakes_and_how_sure_that_is() -> None:
    branch = trained(160)
    batch = collate(moments(16, 2))
    with torch.no_grad():
        raw = branch(batch.own, batch.near)
    guess = correct(raw, batch.lane, batch.gp)
    tame = (batch.own[:, WILD] == 0) & (batch.own[:, CLOSING] == 1)
    moved = (guess - batch.lane)[tame, -1, 0].mean()
    assert -14.0 < moved < -10.0, "1.5 m/s2 for 4 s are 12 m"
    share = confidence(raw[batch.seen][..., 5], raw[batch.looking][..., 6])[:, -1]
    wild = batch.own[batch.seen][:, WILD] == 1
    assert share[wild].mean() < 0.4
    assert share[~wild].mean() > share[wild].mean() + 0.2


def test_the_same_seed_twice_gives_the_same_losses() -> None:
    first, second = (
        [task.update(k)["loss"] for k in range(4)]
        for task in (
            KinematicTask(KinematicConfig(), KinematicTraining(batch=2), 4, moments(4, 0), moments(1, 1))
            for _ in range(2)
        )
    )
    assert first == second
