"""Views as Gymnasium observations: spaces, scaled and bounded values."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import gymnasium
import numpy as np
import numpy.typing as npt

from cosim.envs.session import StepResult
from cosim.errors import one_of
from cosim.observation.view import View
from cosim.road.rules import GREEN, RED, YELLOW
from cosim.seeding import TRAINING_SEEDS
from cosim.types import (
    KINEMATIC_FEATURES,
    ContinuousAction,
    Floats,
    Floats32,
    MetaAction,
    ObservationConfig,
)

Observation = dict[str, npt.NDArray[np.generic]] | Floats32
Space = gymnasium.Space[Observation]

# Divisor of each kinematic feature, for typical values within about +-1; clipped at BOUND. y has a finer
# scale than x: a lane is 3.2 m wide, and 4 * 32 m to the side is out of the perception range.
SCALE = {
    "x": 50.0, "y": 32.0, "speed": 25.0, "heading": np.pi, "length": 10.0, "width": 2.5,
    "is_av": 1.0, "is_mission": 1.0,
}  # fmt: skip
BOUND = 4.0
EGO_FEATURES = (
    "speed", "target_speed", "speed_limit", "lane_changing",
    "to_dead_end_left", "to_dead_end_keep", "to_dead_end_right", "conflict_distance",
    "gap_ahead_left", "gap_ahead_keep", "gap_ahead_right",  # to the next vehicle along that lane
    "gap_behind_left", "gap_behind_keep", "gap_behind_right",
    "faster_ahead_left", "faster_ahead_keep", "faster_ahead_right",  # its speed minus the ego's
    "faster_behind_left", "faster_behind_keep", "faster_behind_right",
)  # fmt: skip
LIMITS = 3  # number of changes of the limit ahead
LAW_FEATURES = (
    "signal_red", "signal_yellow", "signal_green",  # 1 or 0 of the next signal; all 0: none, off, or an arrow
    "signal_distance", "stop_distance", "yield_distance", "crossing_distance", "person_distance",
    "switch_in",  # -1: unknown
    *(f"{what}_{k}" for k in range(1, LIMITS + 1) for what in ("limit_distance", "limit")),
)  # fmt: skip
SPEED = 25.0  # m/s
GAP = 50.0  # m
NO_GAP = 100.0  # m, gap on an empty lane
HALF_LANE = 1.6  # m to either side of a centre line
MAX_DISTANCE = 400.0  # m, scale and cap: no dead end or conflict within it (cosim.road.PATH_HORIZON)
PHASE_SCALE = 60.0  # s
_SCALE = np.array([SCALE[name] for name in KINEMATIC_FEATURES], np.float32)  # [F]

FLATTEN = ("kinematics", "kinematics+law")
RENDER_MODES = ("rgb_array",)


def observation_space(config: ObservationConfig, flatten: str | None) -> Space:
    """Dict(velocity_map, kinematics, valid, ego, law); one Box for an MLP with `flatten`: "kinematics" leaves
    the law out, "kinematics+law" has it."""
    n, r, f, e = config.frames, config.rows, len(KINEMATIC_FEATURES), len(EGO_FEATURES)
    if flatten is not None:
        size = r * f + e + (len(LAW_FEATURES) if flatten == "kinematics+law" else 0)
        return cast(Space, gymnasium.spaces.Box(-BOUND, BOUND, (size,), np.float32))
    spaces: dict[str, gymnasium.Space[object]] = {
        "kinematics": gymnasium.spaces.Box(-BOUND, BOUND, (n, r, f), np.float32),
        "valid": gymnasium.spaces.MultiBinary(n * r),  # [N*R]: TorchRL supports one axis only
        "ego": gymnasium.spaces.Box(-BOUND, BOUND, (e,), np.float32),
        "law": gymnasium.spaces.Box(-1.0, BOUND, (len(LAW_FEATURES),), np.float32),
    }
    if config.maps:
        shape = (n, len(config.channels), config.height, config.width)
        spaces["velocity_map"] = gymnasium.spaces.Box(0, 255, shape, np.uint8)
    return cast(Space, gymnasium.spaces.Dict(spaces))


def action_space(continuous: bool) -> gymnasium.Space[Any]:
    """The five meta-actions; or acceleration in m/s2 and lane offset, which is rounded to +1, 0 or -1."""
    if continuous:
        from cosim.control import MAX_ACCEL, MAX_DECEL  # numba: only when needed

        low, high = np.array([-MAX_DECEL, -1.0], np.float32), np.array([MAX_ACCEL, 1.0], np.float32)
        return gymnasium.spaces.Box(low, high, dtype=np.float32)
    return gymnasium.spaces.Discrete(len(MetaAction))


def action_of(action: Any, continuous: bool) -> int | ContinuousAction:
    """A session's action from an element of `action_space`."""
    return ContinuousAction(float(action[0]), round(float(action[1]))) if continuous else int(action)


def checked(
    observation: ObservationConfig, flatten: str | None, render_mode: str | None
) -> ObservationConfig:
    """The observation of an environment. Raises BadInput for an unknown flatten or mode."""
    if render_mode is not None:
        one_of(render_mode, RENDER_MODES, "render_mode")
    if flatten is None:
        return observation
    one_of(flatten, FLATTEN, "flatten")
    return replace(observation, maps=False)


def training_seed(rng: np.random.Generator) -> int:
    """A seed for an episode without a given one."""
    return int(rng.integers(len(TRAINING_SEEDS)))


def observation(view: View, config: ObservationConfig, flatten: str | None) -> Observation:
    """The View as an element of `observation_space`; `flatten` keeps the newest frame only."""
    if flatten is not None:
        newest = kinematics(view.kinematics[-1])
        newest[~view.valid[-1]] = 0.0
        parts = [newest.ravel(), ego(view), *([law(view)] if flatten == "kinematics+law" else [])]
        return np.concatenate(parts)
    result: dict[str, npt.NDArray[np.generic]] = {
        "kinematics": kinematics(view.kinematics),
        "valid": view.valid.ravel().astype(np.int8),
        "ego": ego(view),
        "law": law(view),
    }
    if config.maps:
        result["velocity_map"] = view.velocity_map
    return result


def nothing(space: Space) -> Observation:
    """The observation of an agent without a vehicle: zeros."""
    parts: Mapping[str, Any] = getattr(space, "spaces", {"": space})
    zeros = {name: np.zeros(part.shape, part.dtype) for name, part in parts.items()}
    return zeros.get("", zeros)


def kinematics(matrix: Floats32) -> Floats32:
    """[..., F] scaled by SCALE and clipped to +-BOUND."""
    return np.asarray(np.clip(matrix / _SCALE, -BOUND, BOUND), np.float32)


def ego(view: View) -> Floats32:
    """[E] EGO_FEATURES: the AV's command, its route, and the next vehicles on the three lanes."""
    speeds = np.array([view.ego_speed, view.target_speed, view.speed_limit]) / SPEED
    distances = np.minimum([*view.to_dead_end, view.conflict_distance], MAX_DISTANCE) / MAX_DISTANCE
    gaps, faster = neighbours(view)
    features = [*speeds, view.lane_changing, *distances, *(gaps / GAP).ravel(), *(faster / SPEED).ravel()]
    return np.asarray(np.clip(features, -BOUND, BOUND), np.float32)


def law(view: View) -> Floats32:
    """[L] LAW_FEATURES: the law on the AV's own route. Missing changes of the limit repeat the last limit at
    MAX_DISTANCE."""
    r = view.rules
    signal = [bool(r.signal) and r.signal in states for states in (RED, YELLOW, GREEN)]
    lines = [r.signal_distance, r.stop_distance, r.yield_distance, r.crossing_distance, r.person_distance]
    limits = np.full((LIMITS, 2), [MAX_DISTANCE, r.limits[-1, 1]])
    ahead = r.limits[1 : 1 + LIMITS]
    limits[: len(ahead)] = ahead
    distances = np.minimum(lines, MAX_DISTANCE) / MAX_DISTANCE
    switch = r.switch_in / PHASE_SCALE if r.switch_in >= 0.0 else -1.0
    features = [*signal, *distances, switch, *(limits / [MAX_DISTANCE, SPEED]).ravel()]
    return np.asarray(np.clip(features, -1.0, BOUND), np.float32)


def neighbours(view: View) -> tuple[Floats, Floats]:
    """Bumper gaps [2,3] m and speed differences [2,3] m/s of the next ahead and behind; left, keep, right.

    A vehicle within half a lane of a centre line is on that lane, as in IDM and MOBIL. A vehicle beside the
    ego has a gap of 0; an empty or missing lane gives NO_GAP and 0.
    """
    gaps, faster = np.full((2, 3), NO_GAP), np.zeros((2, 3))
    others = view.kinematics[-1, 1:][view.valid[-1, 1:]]  # [r,F]
    x, y, speed, _, length = others[:, :5].T
    gap = np.maximum(np.abs(x) - 0.5 * (length + view.kinematics[-1, 0, 4]), 0.0)
    for side in np.flatnonzero(view.lane_exists):
        line = view.centre_lines[side]
        on = np.abs(y - np.interp(x, line[:, 0], line[:, 1])) < HALF_LANE
        for k, beyond in enumerate((x >= 0.0, x < 0.0)):
            rows = np.flatnonzero(on & beyond)
            if len(rows):
                next_one = rows[np.argmin(gap[rows])]
                gaps[k, side] = min(float(gap[next_one]), NO_GAP)
                faster[k, side] = speed[next_one] - view.ego_speed
    return gaps, faster


def decision_info(step: StepResult, av: str) -> dict[str, Any]:
    """One AV's decision in the `info` of both environments: the reward's terms, and whether its command was
    executed (reasons: `Session.receipts`)."""
    receipt = step.receipts.get(av)
    return {
        "reward_terms": step.terms[av]._asdict(),
        "executed": receipt is not None and receipt.executed,
    }
