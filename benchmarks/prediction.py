"""What the kernel bank costs and what it is worth, against per-series maximum likelihood and scikit-learn.

    python -m benchmarks.prediction --recordings DIR [--moments 400] [--vehicles 50] [--json]

Speed: 50 vehicles, one forecast of speed and heading; the fastest of many, so that other work on the machine
counts least. Error: position error of the indirect Gaussian process on the same moments of recorded episodes,
with every way to choose the kernel: per series by maximum likelihood, the bank's most likely one, the bank
averaged, the bank averaged with the fitted prior. Short histories: the same moments, with the earlier frames
hidden.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.maximum_likelihood import fit_series
from cosim.learning.prediction_scores import NORMAL
from cosim.recording.folder import Folder
from cosim.recording.views import windows
from cosim.report import statistics
from cosim.types import Floats
from cosim.workers.memory import keep_freed_memory
from policy.prediction.forecast import integrate_position
from policy.prediction.gaussian_process import HEADING, SPEED, BankConfig, GaussianProcessBank
from policy.predictors.gp import GaussianProcessIndirect

PLAIN = BankConfig(1.0, (0.2, 1.0, 3.0), (0.5, 2.0), (1.0, 2.5), (0.02, 0.2))  # no drifts, no prior
TARGET_MS, TARGET_RATIO = 1.0, 500.0
SHORT = (1, 2, 3, 5, 8, 10)  # frames known


def scikit_learn(series: Floats) -> Floats:
    """Per-series maximum likelihood by scikit-learn: [S,n] in their units -> means [S,20]."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

    past, ahead = 0.2 * np.arange(-9.0, 1.0)[:, None], 0.2 * np.arange(1.0, 21.0)[:, None]
    kernel = (
        ConstantKernel(100.0, "fixed")
        + ConstantKernel(1.0, (4e-4, 400.0)) * DotProduct(0.0, "fixed")
        + ConstantKernel(1.0, (4e-4, 400.0)) * RBF(1.5, (0.3, 10.0))
        + WhiteKernel(0.01, (2.5e-5, 1.0))
    )
    means = []
    for values in series:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = GaussianProcessRegressor(kernel, alpha=1e-9).fit(past, values - values.mean())
        means.append(found.predict(ahead) + values.mean())
    return np.array(means)


def fastest(work: Callable[[], Any], seconds: float) -> float:
    """Fastest of as many calls as fit, in s."""
    work()
    best, end = np.inf, time.perf_counter() + seconds
    while time.perf_counter() < end:
        began = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - began)
    return float(best)


def speed(past: Floats, seconds: float) -> dict[str, float]:
    """Costs for the vehicles of `past` [V,10,4], in ms; each is the fastest of what fits into `seconds`."""
    predictor = GaussianProcessIndirect()
    valid = np.ones(past.shape[:2], np.bool_)
    banks = [
        (bank, np.ascontiguousarray(values))
        for bank, values in zip(predictor.banks, predictor.series(past), strict=True)
    ]
    series = np.concatenate([values / bank.config.unit for bank, values in banks])
    began = time.perf_counter()
    scikit_learn(series)
    slow = time.perf_counter() - began
    ours = fastest(lambda: predictor.predict(past, valid), seconds)
    return {
        "vehicles": len(past),
        "bank_ms": 1e3 * fastest(lambda: [bank.forecast(values) for bank, values in banks], seconds),
        "predictor_ms": 1e3 * ours,
        "target_ms": TARGET_MS,
        "scikit_learn_ms": 1e3 * slow,
        "own_reference_ms": 1e3 * fastest(lambda: [fit_series(s, 1.0) for s in series], 0.2 * seconds),
        "times_faster_than_scikit_learn": slow / ours,
        "target_times_faster": TARGET_RATIO,
    }


def errors(past: Floats, future: Floats, episode: Floats) -> dict[str, dict[str, Any]]:
    """Position error [m] of every way to choose the kernel; its interval is over episodes."""
    state = past[:, -1]
    found: dict[str, Floats] = {}

    def keep(name: str, v: Floats, h: Floats) -> None:
        x, y = integrate_position(state, np.maximum(v, 0.0), h, 0.2)
        found[name] = np.hypot(x - future[:, :, 0], y - future[:, :, 1])

    units = ((past[:, :, 2], SPEED.unit), (past[:, :, 3], HEADING.unit))
    v, h = (np.array([fit_series(s, unit).mean for s in values]) for values, unit in units)
    keep("maximum likelihood, per series", v, h)
    banks = [GaussianProcessBank(replace(PLAIN, unit=unit)) for _, unit in units]
    for name, cold in (("bank, the most likely kernel", 1e-6), ("bank, averaged", 1.0)):
        v, h = (bank.forecast(s, None, cold).mean for bank, (s, _) in zip(banks, units, strict=True))
        keep(name, v, h)
    predicted = GaussianProcessIndirect().predict(past, np.ones(past.shape[:2], np.bool_))
    keep("bank, averaged with the fitted prior (gp-indirect)", predicted.speed, predicted.heading)
    rows: dict[str, dict[str, Any]] = {}
    for name, error in found.items():
        each = np.array([np.nanmean(error[episode == e], 0) for e in np.unique(episode)])  # [E,M]
        rows[name] = {
            f"{s:g} s": round(float(np.nanmean(each[:, round(s / 0.2) - 1])), 3) for s in (1, 2, 3, 4)
        }
        rows[name]["mean"] = statistics.mean(np.nanmean(each, 1)).text(3)
    return rows


def short_histories(past: Floats, future: Floats, episode: Floats) -> dict[str, dict[str, float]]:
    """gp-indirect with the last n frames alone: mean position error [m], and the share of the truth inside
    the 90 % interval along the road."""
    predictor, found = GaussianProcessIndirect(), {}
    for known in SHORT:
        valid = np.zeros(past.shape[:2], np.bool_)
        valid[:, -known:] = True
        f = predictor.predict(past, valid)
        dx, dy = future[:, :, 0] - f.x, future[:, :, 1] - f.y
        along = np.abs(np.cos(f.heading) * dx + np.sin(f.heading) * dy)
        inside = np.where(np.isfinite(along), along <= NORMAL * f.along_std, np.nan)
        means = [
            np.mean([np.nanmean(values[episode == e]) for e in np.unique(episode)])
            for values in (np.hypot(dx, dy), inside)
        ]
        found[f"{known} frames"] = {"mean": round(float(means[0]), 3), "inside": round(float(means[1]), 3)}
    return found


def sample(folder: Folder, moments: int) -> tuple[Floats, Floats, Floats]:
    """Moments with a whole past drawn evenly from every recording: past, future, episode."""
    keys = folder.episodes()
    rng = np.random.default_rng(0)
    parts = []
    for e, recording in enumerate(folder.recordings()):
        w = windows(recording, every=10)
        whole = np.flatnonzero(np.isfinite(w.past).all((1, 2)) & np.isfinite(w.future[:, 0]).all(1))
        chosen = rng.permutation(whole)[: max(moments // len(keys), 1)]
        parts.append((w.past[chosen], w.future[chosen], np.full(len(chosen), e)))
    past, future, episode = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return past, future, episode


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--recordings", required=True, metavar="DIR", help="a folder of `cosim record`")
    parser.add_argument("--moments", type=int, default=2000, help="for the error")
    parser.add_argument("--vehicles", type=int, default=50, help="for the speed")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each cost")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    keep_freed_memory()
    past, future, episode = sample(Folder(Path(args.recordings)), args.moments)
    few = np.random.default_rng(1).permutation(len(past))[: args.vehicles]
    result = {
        "moments": len(past),
        "speed": speed(past[few], args.seconds),
        "position_error_m": errors(past, future, episode),
        "short_histories": short_histories(past, future, episode),
    }
    print(json.dumps(result, indent=None if args.json else 2))


if __name__ == "__main__":
    main()
