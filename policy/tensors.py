"""The only crossing between numpy and torch: histories in, network inputs out, action values back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from cosim.actions import SPEED_STEP
from cosim.types import KINEMATIC_FEATURES, Bools, Bytes, Floats, Floats32, History

# Scales that bring every kinematic feature to about [-1, 1]: row range, map half width, motorway speed,
# a U-turn, a lorry; is_av and is_mission stay.
KINEMATIC_SCALE = np.array([125.0, 16.0, 30.0, np.pi, 10.0, 3.0, 1.0, 1.0], np.float32)
KINEMATIC_INPUTS = len(KINEMATIC_FEATURES) + 1  # the features and the mask
LOOK_AHEAD = np.array([20.0, 50.0, 100.0])  # m, where the candidate centre lines are sampled
ROUTE_INPUTS = 7 + 3 * (3 + 2 * len(LOOK_AHEAD))
FAR = 200.0  # m: lane ends and conflict zones further away are all alike


class Batch(NamedTuple):
    """What the networks see of B AVs."""

    maps: torch.Tensor  # [B,N,C,H,W] float32 in [0,1]
    kinematics: torch.Tensor  # [B,N,R,F+1] float32, scaled, the mask last; zeros in masked rows
    route: torch.Tensor  # [B,ROUTE_INPUTS] float32
    phi: torch.Tensor  # [B,2] cos, sin of the social value orientation


def to_batch(histories: Sequence[History], svo: float, device: str = "cpu") -> Batch:
    """Network inputs for AVs that decide together; `svo` in rad."""
    maps = np.stack([h.velocity_map for h in histories])
    kinematics = np.stack([h.kinematics for h in histories])
    valid = np.stack([h.valid for h in histories])
    route = np.stack([route_features(h) for h in histories])
    phi = torch.tensor([np.cos(svo), np.sin(svo)], dtype=torch.float32, device=device)
    return Batch(
        map_tensor(maps, device),
        kinematic_tensor(kinematics, valid, device),
        torch.from_numpy(route).to(device),
        phi.expand(len(histories), 2),
    )


def map_tensor(maps: Bytes, device: str = "cpu") -> torch.Tensor:
    """uint8 maps of any shape -> float32 in [0,1]."""
    return torch.from_numpy(np.ascontiguousarray(maps)).to(device).to(torch.float32).mul_(1.0 / 255.0)


def kinematic_tensor(kinematics: Floats32 | Floats, valid: Bools, device: str = "cpu") -> torch.Tensor:
    """[...,R,F] m, m/s, rad and mask [...,R] -> scaled float32 [...,R,F+1]; masked or NaN rows become 0."""
    scaled = np.asarray(kinematics, np.float32) / KINEMATIC_SCALE
    mask = valid & np.isfinite(scaled).all(-1)
    out = np.concatenate([scaled, np.ones_like(scaled[..., :1])], -1)
    out = np.where(mask[..., None], out, np.float32(0.0))
    return torch.from_numpy(out).to(device)


def route_features(history: History) -> Floats32:
    """The ego's own route knowledge and command [ROUTE_INPUTS], scaled to about [-1, 1].

    Target speed, speed limit, distance to the conflict zone, lane change under way, own speed, how many
    grid levels the target may still rise, how far the speed is from it; then for
    the left, present and right lane: does it exist, does it dead-end, how far off, and where its centre
    line lies LOOK_AHEAD m ahead (offset and direction in the ego frame).
    """
    route, pose = history.route, history.pose
    out = [
        history.target_speed / 30.0,
        route.speed_limit / 30.0,
        min(route.conflict_distance, FAR) / FAR,
        float(history.lane_changing),
        history.ego_speed / 30.0,
        np.clip((route.speed_limit - history.target_speed) / SPEED_STEP, -1.0, 2.0),
        np.clip((history.ego_speed - history.target_speed) / SPEED_STEP, -1.0, 1.0),
    ]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for side, path in enumerate(route.paths):
        if path is None:
            out += [0.0] * (3 + 2 * len(LOOK_AHEAD))
            continue
        x, y, heading = path.pose(route.arc + LOOK_AHEAD)
        left = c * (y - pose[1]) - s * (x - pose[0])
        turn = (heading - pose[2] + np.pi) % (2 * np.pi) - np.pi
        out += [1.0, float(path.dead_end), min(route.to_end(side), FAR) / FAR]
        out += [float(v) for v in left / 50.0] + [float(v) for v in turn / np.pi]
    return np.array(out, np.float32)


def to_numpy(values: torch.Tensor) -> Floats32:
    """Any tensor -> float32 numpy on the host."""
    return np.asarray(values.detach().to("cpu", torch.float32).numpy(), np.float32)
