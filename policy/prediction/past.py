"""The known past of every vehicle, completed to whole histories: predictors are fitted on nothing shorter.

A vehicle that came into view two frames ago has a past too, only an unknown one. A predictor fitted on
complete histories only does not learn what missing frames mean: with one known frame the fitted
prior erred by three times constant speed. So what is not known is taken to have been as the two oldest known
frames show; with a single one, constant speed (measured on tuning seeds, docs/explanation/prediction.md).
"""

import numpy as np

from cosim.geometry.compiled import compiled
from cosim.types import Bools, Floats, Ints

ORDINARY = 3.0  # m/s2: who brakes harder than this now has hardly done so for two seconds


@compiled
def trailing_run(state: Floats, valid: Bools) -> Ints:
    """How many unbroken valid, finite frames lead up to now.

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

    Speed (its slope within ORDINARY) and heading go back as the two oldest known frames show, nobody
    reverses, and the places follow from both (P, eq. 9 backwards). A longer past is cut; zeros for a vehicle
    that is not known now.

    Args:
        state: [V,N,>=4] x m, y m, speed m/s, heading rad, oldest first.
        run: [V] from `trailing_run`.
        frames: of a whole history.
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
            gain = min(max(gain, -ORDINARY * dt), ORDINARY * dt)
            turn = out[v, oldest + 1, 3] - out[v, oldest, 3]
        for k in range(oldest - 1, -1, -1):
            x, y, speed, heading = out[v, k + 1]
            before, turned = max(speed - gain, 0.0), heading - turn
            out[v, k, 0] = x - 0.5 * dt * (speed * np.cos(heading) + before * np.cos(turned))
            out[v, k, 1] = y - 0.5 * dt * (speed * np.sin(heading) + before * np.sin(turned))
            out[v, k, 2], out[v, k, 3] = before, turned
    return out
