"""Cost of one forecast of the indirect Gaussian process for 50 vehicles.

    python -m benchmarks.prediction --recordings DIR [--vehicles 50] [--seconds 5] [--json]

The minimum of many runs, to reduce the effect of other load.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cosim.recording.folder import Folder
from cosim.recording.views import windows
from cosim.types import Floats
from cosim.workers.memory import keep_freed_memory
from policy.prediction.gp import GaussianProcessIndirect

TARGET_MS = 1.0
MOMENTS = 20  # per recording, at most


def fastest(work: Callable[[], Any], seconds: float) -> float:
    """Duration of the fastest of all calls within `seconds`, s."""
    work()
    best, end = np.inf, time.perf_counter() + seconds
    while time.perf_counter() < end:
        began = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - began)
    return float(best)


def speed(past: Floats, seconds: float) -> dict[str, float]:
    """Costs for the vehicles of `past` [V,10,4], ms; each the fastest of all calls within `seconds`."""
    predictor = GaussianProcessIndirect()
    valid = np.ones(past.shape[:2], np.bool_)
    banks = [
        (bank, np.ascontiguousarray(values))
        for bank, values in zip(predictor.banks, predictor.series(past), strict=True)
    ]
    return {
        "vehicles": len(past),
        "bank_ms": 1e3 * fastest(lambda: [bank.forecast(values) for bank, values in banks], seconds),
        "predictor_ms": 1e3 * fastest(lambda: predictor.predict(past, valid), seconds),
        "target_ms": TARGET_MS,
    }


def sample(folder: Folder, vehicles: int) -> Floats:
    """Past [V,10,4] of random vehicles from all recordings, with complete histories."""
    rng = np.random.default_rng(0)
    parts = []
    for recording in folder.recordings():
        past = windows(recording, every=10).past
        whole = np.flatnonzero(np.isfinite(past).all((1, 2)))
        parts.append(past[rng.permutation(whole)[:MOMENTS]])
    found = np.concatenate(parts)
    return found[rng.permutation(len(found))[:vehicles]]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--recordings", required=True, metavar="DIR", help="a folder of `cosim record`")
    parser.add_argument("--vehicles", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=5.0, help="for each cost")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    keep_freed_memory()
    past = sample(Folder(Path(args.recordings)), args.vehicles)
    print(json.dumps(speed(past, args.seconds), indent=None if args.json else 2))


if __name__ == "__main__":
    main()
