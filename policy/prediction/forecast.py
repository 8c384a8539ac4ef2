"""Predicted states of many vehicles, and the integral that turns speed and heading into position."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.types import HEADING, SPEED, Bools, Floats, X, Y


class KinematicForecast(NamedTuple):
    """Predicted states of V vehicles at M frames ahead; zeros where `valid` is False."""

    x: Floats  # [V,M] m
    y: Floats  # [V,M] m
    speed: Floats  # [V,M] m/s, never negative
    heading: Floats  # [V,M] rad, unwrapped
    speed_std: Floats  # [V,M] m/s, zero for predictors without an error estimate
    heading_std: Floats  # [V,M] rad
    along_std: Floats  # [V,M] m, of the position in the predicted driving direction
    across_std: Floats  # [V,M] m
    valid: Bools  # [V] was perceived in the newest frame

    @classmethod
    def without_spread(
        cls, x: Floats, y: Floats, speed: Floats, heading: Floats, valid: Bools
    ) -> KinematicForecast:
        """States [V,M] of a predictor without an error estimate; valid [V]."""
        zero = np.zeros_like(x)
        return cls(x, y, speed, heading, zero, zero, zero, zero, valid)


@compiled
def integrate_position(now: Floats, speed: Floats, heading: Floats, dt: float) -> tuple[Floats, Floats]:
    """Positions from predicted speeds and headings by the trapezoid rule (P, eq. 9).

    Args:
        now: [V,>=4] x m, y m, speed m/s, heading rad.
        speed: [V,M] m/s.
        heading: [V,M] rad.
        dt: s between frames.

    Returns:
        x, y: [V,M] m.
    """
    x, y = np.empty(speed.shape), np.empty(speed.shape)
    for v in range(speed.shape[0]):
        px, py = now[v, X], now[v, Y]
        vx, vy = now[v, SPEED] * np.cos(now[v, HEADING]), now[v, SPEED] * np.sin(now[v, HEADING])
        for k in range(speed.shape[1]):
            wx, wy = speed[v, k] * np.cos(heading[v, k]), speed[v, k] * np.sin(heading[v, k])
            px += 0.5 * dt * (vx + wx)
            py += 0.5 * dt * (vy + wy)
            x[v, k], y[v, k] = px, py
            vx, vy = wx, wy
    return x, y


def motion_of(now: Floats, x: Floats, y: Floats, dt: float) -> tuple[Floats, Floats]:
    """Speed and heading along predicted positions; a vehicle that hardly moves keeps its heading.

    Args:
        now: [V,>=4] x m, y m, speed m/s, heading rad.
        x, y: [V,M] m.
        dt: s between frames.

    Returns:
        speed [V,M] m/s, heading [V,M] rad (unwrapped).
    """
    dx = np.diff(np.concatenate([now[:, X, None], x], 1), axis=1)
    dy = np.diff(np.concatenate([now[:, Y, None], y], 1), axis=1)
    step = np.hypot(dx, dy)
    turn = np.arctan2(dy, dx) - now[:, HEADING, None]
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    moving = step > 0.1 * dt
    last = np.maximum.accumulate(np.where(moving, np.arange(1, x.shape[1] + 1), 0), axis=1)  # 0: never yet
    held = np.take_along_axis(np.concatenate([np.zeros_like(turn[:, :1]), turn], 1), last, 1)
    return step / dt, now[:, HEADING, None] + np.unwrap(held, axis=1)
