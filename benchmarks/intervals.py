"""Values with 95 % intervals: proportions, rates, quantiles and medians of autocorrelated samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, chi2, norm


@dataclass(frozen=True, slots=True)
class Figure:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float

    def text(self, digits: int, scale: float = 1.0) -> str:
        if math.isnan(self.value):
            return "-"
        value, low, high = (f"{scale * x:.{digits}f}" for x in (self.value, self.low, self.high))
        return f"{value} ({low} to {high})"


def share(hits: int, count: int) -> Figure:
    """Wilson's interval of a proportion."""
    if count == 0:
        return Figure(math.nan, math.nan, math.nan)
    z, p = float(norm.ppf(0.975)), hits / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return Figure(p, max(0.0, middle - half), min(1.0, middle + half))


def rate(count: int, exposure: float) -> Figure:
    """Exact Poisson interval of events per unit of exposure."""
    low = chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    return Figure(
        count / exposure, float(low) / exposure, float(chi2.ppf(0.975, 2 * count + 2)) / 2 / exposure
    )


def quantile(values: Sequence[float], q: float) -> Figure:
    """A quantile of independent values with its order-statistic interval; nan values are left out."""
    ordered = np.sort([v for v in values if not math.isnan(v)])
    if len(ordered) < 2:
        return Figure(math.nan, math.nan, math.nan)
    low, high = (int(binom.ppf(p, len(ordered), q)) for p in (0.025, 0.975))
    last = len(ordered) - 1
    return Figure(
        float(np.quantile(ordered, q)), float(ordered[min(low, last)]), float(ordered[min(high, last)])
    )


def median_of_blocks(samples: Sequence[tuple[int, float]]) -> Figure:
    """Median of autocorrelated samples: bootstrap over whole blocks (minutes)."""
    blocks: dict[int, list[float]] = {}
    for block, value in samples:
        blocks.setdefault(block, []).append(value)
    parts = [np.asarray(v) for v in blocks.values()]
    if not parts:
        return Figure(math.nan, math.nan, math.nan)
    rng = np.random.default_rng(0)
    medians = [
        np.median(np.concatenate([parts[i] for i in rng.integers(0, len(parts), len(parts))]))
        for _ in range(200)
    ]
    value = float(np.median(np.concatenate(parts)))
    return Figure(value, float(np.quantile(medians, 0.025)), float(np.quantile(medians, 0.975)))
