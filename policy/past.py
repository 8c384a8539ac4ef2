"""The known past of every vehicle, completed to whole histories: predictors are fitted on nothing shorter.

A vehicle that came into view two frames ago has a past too, only an unknown one. Told of whole histories
alone, a learned predictor takes silence for calm, or for anything at all: with one known frame the fitted
prior erred by three times constant speed. So what is not known is taken to have been as the two oldest known
frames show; with a single one, constant speed (measured on tuning seeds, docs/prediction.md).
"""

from __future__ import annotations

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.types import Bools, Floats, Ints

ORDINARY = 3.0  # m/s2: who brakes harder than this now has hardly done so for two seconds


def trailing_run(state: Floats, valid: Bools) -> Ints:
    """[V] how many unbroken valid, finite frames lead up to now; state [V,N,>=4], valid [V,N]."""
    run = np.empty(len(state), np.int64)
    _trailing_run(state, valid, run)
    return run


def whole_past(state: Floats, run: Ints, frames: int, dt: float) -> Floats:
    """[V,frames,4] x y speed heading, known or completed; `run` from `trailing_run` of state [V,N,>=4].

    Speed (its slope within ORDINARY) and heading go back as the two oldest known frames show, nobody
    reverses, and the places follow from both (P, eq. 9 backwards). A longer past is cut; zeros for a vehicle
    that is not known now.
    """
    out = np.zeros((len(state), frames, 4))
    _whole_past(state, run, dt, out)
    return out


@compiled
def _trailing_run(state: Floats, valid: Bools, run: Ints) -> None:
    for v in range(state.shape[0]):
        run[v] = 0
        for k in range(state.shape[1] - 1, -1, -1):
            whole = valid[v, k]
            for f in range(4):
                whole = whole and np.isfinite(state[v, k, f])
            if not whole:
                break
            run[v] += 1


@compiled
def _whole_past(state: Floats, run: Ints, dt: float, out: Floats) -> None:
    frames = out.shape[1]
    for v in range(state.shape[0]):
        known = min(run[v], frames)
        if known == 0:
            continue
        for k in range(known):
            for f in range(4):
                out[v, frames - 1 - k, f] = state[v, state.shape[1] - 1 - k, f]
        oldest = frames - known
        gain = turn = 0.0
        if known > 1:
            gain = out[v, oldest + 1, 2] - out[v, oldest, 2]
            gain = min(max(gain, -ORDINARY * dt), ORDINARY * dt)
            turn = out[v, oldest + 1, 3] - out[v, oldest, 3]
        for k in range(oldest - 1, -1, -1):
            x, y, speed, heading = out[v, k + 1]
            before, turned = max(speed - gain, 0.0), heading - turn
            out[v, k, 0] = x - 0.5 * dt * (speed * np.cos(heading) + before * np.cos(turned))
            out[v, k, 1] = y - 0.5 * dt * (speed * np.sin(heading) + before * np.sin(turned))
            out[v, k, 2], out[v, k, 3] = before, turned
