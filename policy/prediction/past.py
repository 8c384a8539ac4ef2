"""The known past of every vehicle, completed to whole histories, because predictors are fitted on those only.

A vehicle that came into view two frames ago has an unknown past. A predictor fitted on complete histories
does not learn the meaning of missing frames: with one known frame the fitted prior has three times the error
of constant speed. Unknown frames are therefore extrapolated from the two oldest known frames, and with a
single known frame at constant speed (measured on validation seeds, docs/explanation/prediction.md).
"""

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.types import Bools, Floats, Ints

MAX_PAST_ACCEL = 3.0  # m/s2: harder braking rarely lasts two seconds


@compiled
def trailing_run(state: Floats, valid: Bools) -> Ints:
    """The number of consecutive valid, finite frames up to now.

    Args:
        state: [V,N,>=4] oldest first.
        valid: [V,N].

    Returns:
        [V] frames.
    """
    run = np.zeros(len(state), np.int64)
    for v in range(state.shape[0]):
        for k in range(state.shape[1] - 1, -1, -1):
            whole = valid[v, k]
            for f in range(4):
                whole = whole and np.isfinite(state[v, k, f])
            if not whole:
                break
            run[v] += 1
    return run


@compiled
def whole_past(state: Floats, run: Ints, frames: int, dt: float) -> Floats:
    """The past of every vehicle as a whole history, known or completed.

    Speed (slope limited to MAX_PAST_ACCEL, never negative) and heading are extrapolated backwards from the
    two oldest known frames; positions follow from both (P, eq. 9 backwards). A longer past is cut. Vehicles
    not known now get zeros.

    Args:
        state: [V,N,>=4] x m, y m, speed m/s, heading rad, oldest first.
        run: [V] from `trailing_run`.
        frames: length of a whole history.
        dt: s between frames.

    Returns:
        [V,frames,4] x m, y m, speed m/s, heading rad.
    """
    out = np.zeros((len(state), frames, 4))
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
            gain = min(max(gain, -MAX_PAST_ACCEL * dt), MAX_PAST_ACCEL * dt)
            turn = out[v, oldest + 1, 3] - out[v, oldest, 3]
        for k in range(oldest - 1, -1, -1):
            x, y, speed, heading = out[v, k + 1]
            before, turned = max(speed - gain, 0.0), heading - turn
            out[v, k, 0] = x - 0.5 * dt * (speed * np.cos(heading) + before * np.cos(turned))
            out[v, k, 1] = y - 0.5 * dt * (speed * np.sin(heading) + before * np.sin(turned))
            out[v, k, 2], out[v, k, 3] = before, turned
    return out
