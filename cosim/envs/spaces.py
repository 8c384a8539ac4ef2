"""Views as Gymnasium observations: the spaces and the numbers in them, scaled and bounded."""

from __future__ import annotations

from typing import cast

import gymnasium
import numpy as np
import numpy.typing as npt

from cosim.envs.view import View
from cosim.types import KINEMATIC_FEATURES, Floats32, MetaAction, ObservationConfig

Observation = dict[str, npt.NDArray[np.generic]] | Floats32
Space = gymnasium.Space[Observation]

# What each kinematic feature is divided by, so that values in use lie within about +-1; clipped at BOUND.
# y is finer than x: a lane is 3.2 m wide, and what is 4 * 32 m to the side is out of perception's range.
SCALE = {
    "x": 50.0, "y": 32.0, "speed": 25.0, "heading": np.pi, "length": 10.0, "width": 2.5,
    "is_av": 1.0, "is_mission": 1.0,
}  # fmt: skip
BOUND = 4.0
EGO_FEATURES = (
    "target_speed", "speed_limit", "lane_changing",
    "to_dead_end_left", "to_dead_end_keep", "to_dead_end_right", "conflict_distance",
)  # fmt: skip
SPEED = 25.0  # m/s that count as 1
FAR = 400.0  # m that count as 1, and beyond: no dead end, no conflict (cosim.road.PATH_HORIZON)
_SCALE = np.array([SCALE[name] for name in KINEMATIC_FEATURES], np.float32)  # [F]

FLATTEN = (None, "kinematics")


def observation_space(config: ObservationConfig, flatten: str | None) -> Space:
    """Dict(velocity_map, kinematics, valid, ego); with `flatten="kinematics"` one Box for an MLP."""
    n, r, f, e = config.frames, config.rows, len(KINEMATIC_FEATURES), len(EGO_FEATURES)
    if flatten == "kinematics":
        return cast(Space, gymnasium.spaces.Box(-BOUND, BOUND, (r * f + e,), np.float32))
    spaces: dict[str, gymnasium.Space[object]] = {
        "kinematics": gymnasium.spaces.Box(-BOUND, BOUND, (n, r, f), np.float32),
        "valid": gymnasium.spaces.MultiBinary((n, r)),
        "ego": gymnasium.spaces.Box(-BOUND, BOUND, (e,), np.float32),
    }
    if config.maps:
        shape = (n, len(config.channels), config.height, config.width)
        spaces["velocity_map"] = gymnasium.spaces.Box(0, 255, shape, np.uint8)
    return cast(Space, gymnasium.spaces.Dict(spaces))


def action_space() -> gymnasium.spaces.Discrete:
    """The five meta-actions, in the order of `MetaAction`."""
    return gymnasium.spaces.Discrete(len(MetaAction))


def observation(view: View, config: ObservationConfig, flatten: str | None) -> Observation:
    """The View in the numbers of `observation_space`; `flatten` keeps the newest frame only."""
    if flatten == "kinematics":
        newest = kinematics(view.kinematics[-1])
        newest[~view.valid[-1]] = 0.0
        return np.concatenate([newest.ravel(), ego(view)])
    result: dict[str, npt.NDArray[np.generic]] = {
        "kinematics": kinematics(view.kinematics),
        "valid": view.valid.astype(np.int8),
        "ego": ego(view),
    }
    if config.maps:
        result["velocity_map"] = view.velocity_map
    return result


def kinematics(matrix: Floats32) -> Floats32:
    """[..., F] scaled by SCALE and clipped to +-BOUND."""
    return np.asarray(np.clip(matrix / _SCALE, -BOUND, BOUND), np.float32)


def ego(view: View) -> Floats32:
    """[E] EGO_FEATURES: the AV's own command and what its route knows."""
    speeds = np.array([view.target_speed, view.speed_limit]) / SPEED
    distances = np.minimum([*view.to_dead_end, view.conflict_distance], FAR) / FAR
    bounded = np.clip([*speeds, view.lane_changing, *distances], -BOUND, BOUND)
    return np.asarray(bounded, np.float32)


def action_mask(view: View) -> npt.NDArray[np.int8]:
    """[A] 1 where the action can do something, as `Discrete.sample(mask)` wants it."""
    return view.action_mask.astype(np.int8)
