"""Values with 95 % intervals: shares, rates, means, quantiles, and differences of pairs on equal seeds.

Uses and validation: docs/explanation/statistics.md. In this module NA is nan, never 0.
"""

import math
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats
from scipy.optimize import brentq

CONFIDENCE = 0.95
Z = float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))
RESAMPLES = 2000  # bounds of a mean vary by about 2 % of the interval's width between seeds
FEW_EVENTS = 3.0  # effective events, from which their largest weight bounds the weight of another event
# Effective events of two rates, and effective samples with an event, from which the difference of the rates
# is approximately normal.
NORMAL_EVENTS, NORMAL_SAMPLES = 20.0, 10.0
MAX_RESAMPLED_VALUES = 2_000_000  # held at once: 16 MB

Array = npt.NDArray[np.float64]
Bools = Sequence[bool] | npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Figure:
    """A value and its 95 % interval; nan if missing."""

    value: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether the value is not NA."""
        return not math.isnan(self.value)

    def text(self, digits: int, scale: float = 1.0) -> str:
        """`value (low to high)`; "-" for NA, the value alone without an interval."""
        if not self.known:
            return "-"
        value, low, high = (f"{scale * x:.{digits}f}" for x in (self.value, self.low, self.high))
        return value if math.isnan(self.low) else f"{value} ({low} to {high})"

    def document(self) -> dict[str, float | None]:
        """For JSON: nan and infinities as null."""
        pairs = (("value", self.value), ("low", self.low), ("high", self.high))
        return {name: x if math.isfinite(x) else None for name, x in pairs}


NA = Figure(math.nan, math.nan, math.nan)


# ---- one sample ----


def share(hits: int, count: int) -> Figure:
    """A proportion with Wilson's interval (1927), which is sound at 0 and at small counts."""
    if count == 0:
        return NA
    found = stats.binomtest(hits, count).proportion_ci(CONFIDENCE, method="wilson")
    return Figure(hits / count, float(found.low), float(found.high))


def rule_of_three(count: int) -> float:
    """Upper 95 % bound of a proportion never observed in `count` trials: 3 / count (Hanley 1983).

    nan for 0 trials. One-sided, hence a little below Wilson's two-sided bound.
    """
    return min(3.0 / count, 1.0) if count else math.nan


def rate(count: int, exposure: float) -> Figure:
    """Events per unit of exposure with the exact Poisson interval (Garwood 1936)."""
    tail = (1.0 - CONFIDENCE) / 2.0
    low = stats.chi2.ppf(tail, 2 * count) / 2 if count else 0.0
    high = stats.chi2.ppf(1.0 - tail, 2 * count + 2) / 2
    return Figure(count / exposure, float(low) / exposure, float(high) / exposure)


def pooled_rate(
    counts: Sequence[float] | Array,
    exposures: Sequence[float] | Array,
    weights: Sequence[float] | Array | None = None,
    times: float = 1.0,
) -> Figure:
    """Events per unit of exposure of n samples: R = sum(w y) / sum(w k), with a gamma interval.

    The interval is for weighted Poisson counts (Fay and Feuer, Statistics in Medicine 16 (1997) 791-801). Its
    variance is that of the ratio, sum(w^2 (y - R k)^2), and at least the Poisson variance sum(w^2 y), since
    events of one episode are not independent. The upper bound allows for one more event (or a cluster) with
    the largest weight of the observed events. With fewer effective events than `FEW_EVENTS` it allows for the
    largest weight of all samples. With equal weights and Poisson scatter it is the exact interval of `rate`.

    Args:
        counts: [n] y, events of each sample.
        exposures: [n] k, exposure of each sample.
        weights: [n] w, positive likelihood ratios; None: all equal.
        times: factor on the number of samples, for the interval of a larger sample like this one.
    """
    y, k = np.asarray(counts, np.float64), np.asarray(exposures, np.float64)
    w = np.ones(len(y)) if weights is None else np.asarray(weights, np.float64)
    exposure, events = times * float((w * k).sum()), times * float((w * y).sum())
    if not exposure > 0.0:
        return NA
    tail = (1.0 - CONFIDENCE) / 2.0
    if events == 0.0:
        return Figure(0.0, 0.0, float(w.max() * stats.chi2.ppf(1.0 - tail, 2) / 2.0) / exposure)
    scatter = times * float((w**2 * (y - events / exposure * k) ** 2).sum()) * len(y) / max(len(y) - 1, 1)
    poisson = times * float((w**2 * y).sum())
    variance = max(scatter, poisson)
    seen = w[y > 0.0]
    largest = float(seen.max() if times * effective(seen) >= FEW_EVENTS else w.max()) * variance / poisson

    def bound(p: float, mean: float, spread: float) -> float:
        """The p-quantile of the gamma distribution of this mean and variance."""
        return float(stats.gamma.ppf(p, mean**2 / spread, scale=spread / mean)) / exposure

    low, high = bound(tail, events, variance), bound(1.0 - tail, events + largest, variance + largest**2)
    return Figure(events / exposure, low, high)


def effective(weights: Sequence[float] | Array) -> float:
    """The effective sample size (sum w)^2 / sum w^2 (Kish 1965); 0 without weights."""
    w = np.asarray(weights, np.float64)
    total = float((w**2).sum())
    return float(w.sum()) ** 2 / total if total > 0.0 else 0.0


def mean(values: Sequence[float] | Array, seed: int = 0) -> Figure:
    """A mean with its BCa bootstrap interval (Efron 1987); nan values are left out.

    Bounds: nan with fewer than two values; the value itself when all are equal (nothing to resample).
    `seed` fixes the resampling: equal values, equal figure.
    """
    return _bootstrap((_known(values),), np.mean, seed)


def grouped_mean(values: Sequence[float] | Array, groups: Sequence[Hashable], seed: int = 0) -> Figure:
    """A mean whose values come in groups that are not independent inside; nan values are left out.

    `groups`: the group of each value. The bootstrap (BCa) resamples whole groups.
    """
    known = [(group, value) for group, value in zip(groups, values, strict=True) if not math.isnan(value)]
    place = {group: k for k, group in enumerate(dict.fromkeys(group for group, _ in known))}
    sums, counts = np.zeros((2, len(place)))
    for group, value in known:
        sums[place[group]] += value
        counts[place[group]] += 1.0
    return _bootstrap((sums, counts), _ratio, seed)


def quantile(values: Sequence[float] | Array, q: float) -> Figure:
    """A quantile of independent values with its order-statistic interval; nan values are left out."""
    ordered = np.sort(_known(values))
    if len(ordered) < 2:
        return NA
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = (int(stats.binom.ppf(p, len(ordered), q)) for p in (tail, 1.0 - tail))
    last = len(ordered) - 1  # of n values the low-th and the (high + 1)-th smallest, counted from 1
    return Figure(
        float(np.quantile(ordered, q)), float(ordered[max(low - 1, 0)]), float(ordered[min(high, last)])
    )


# ---- pairs on equal seeds: entry i of `before` and of `after` is the same traffic ----


def paired_share(before: Bools, after: Bools, tests: int = 1) -> Figure:
    """Difference of two proportions, after - before, with Tango's score interval (1998).

    This interval keeps its width if no pair differs, and its coverage at small counts. It is wider for
    `tests` intervals that hold together (`widened`).
    """
    lost, gained = discordant(before, after)
    return _tango(gained, lost, len(before), widened(tests) * Z)


def discordant(before: Bools, after: Bools) -> tuple[int, int]:
    """Numbers of pairs that changed from yes to no, and from no to yes."""
    b, a = np.asarray(before, np.bool_), np.asarray(after, np.bool_)
    return int((b & ~a).sum()), int((a & ~b).sum())


def mcnemar(lost: int, gained: int) -> float:
    """Exact two-sided p of "equally many pairs change either way" (McNemar 1947); 1 without changes."""
    if lost + gained == 0:
        return 1.0
    return float(stats.binomtest(gained, lost + gained, 0.5).pvalue)


def signed_rank(before: Sequence[float] | Array, after: Sequence[float] | Array) -> float:
    """Two-sided p of "pairs change equally in both directions" (Wilcoxon 1945, ties by Pratt).

    1 without changes. Pairs with a nan are left out.
    """
    change = _known(np.asarray(after, np.float64) - np.asarray(before, np.float64))
    return float(stats.wilcoxon(change, zero_method="pratt").pvalue) if change.any() else 1.0


def holm(p: Sequence[float]) -> list[float]:
    """Each p corrected for all of these tests, by Holm's method (1979)."""
    order = np.argsort(p)
    steps = np.minimum(1.0, np.asarray(p)[order] * np.arange(len(p), 0, -1))
    out = np.empty(len(p))
    out[order] = np.maximum.accumulate(steps)
    return [float(x) for x in out]


def power(effect: float, difference: Figure, tests: int = 1) -> float:
    """The probability of finding a true difference of `effect`, with the standard error of `difference`.

    Normal approximation from the width of the interval. `tests`: number of tests that are corrected together
    (the first step of `holm`). nan without an interval.
    """
    error = (difference.high - difference.low) / (2.0 * Z)
    needed = widened(tests) * Z
    return 1.0 if error == 0.0 else float(stats.norm.cdf(abs(effect) / error - needed))


def widened(tests: int) -> float:
    """The factor on the half width of an interval, in which `tests` intervals hold together.

    Bonferroni's correction; normal approximation.
    """
    return float(stats.norm.isf((1.0 - CONFIDENCE) / 2.0 / tests)) / Z


def paired_mean(before: Sequence[float] | Array, after: Sequence[float] | Array, seed: int = 0) -> Figure:
    """Mean of the differences after - before, BCa bootstrap over pairs; pairs with a nan are left out."""
    difference = np.asarray(after, np.float64) - np.asarray(before, np.float64)
    return _bootstrap((_known(difference),), np.mean, seed)


def paired_change(before: Sequence[float] | Array, after: Sequence[float] | Array, seed: int = 0) -> Figure:
    """Relative change of the mean, mean(after) / mean(before) - 1, bootstrapped over pairs.

    inf or -inf when only the mean before is 0. No bounds if that can happen in a resample.
    """
    both = np.array([before, after], np.float64)
    b, a = both[:, ~np.isnan(both).any(0)]
    if len(b) and b.mean() == 0.0:
        change = 0.0 if a.mean() == 0.0 else math.copysign(math.inf, a.mean())
        return Figure(change, math.nan if change else 0.0, math.nan if change else 0.0)
    return _bootstrap((b, a), _change, seed)


def paired_rate(before: Array, after: Array) -> Figure:
    """Difference of two pooled rates, after - before.

    `before`, `after`: [3,n] events, exposure and weight of every pair (or [2,n] with equal weights), as for
    `pooled_rate`. With at least `NORMAL_EVENTS` effective events the error is from the contributions of
    single pairs (delta method). With fewer the bounds are from the bounds of the two rates and the
    correlation of the contributions (MOVER, Zou and Donner, Statistics in Medicine 27 (2008) 1693-1702).
    """
    a, b = pooled_rate(*before), pooled_rate(*after)
    if not (a.known and b.known):
        return NA
    return _difference(a, b, _contributions(before, a), _contributions(after, b), _normal(before, after))


def paired_rate_change(before: Array, after: Array) -> Figure:
    """Relative change of a pooled rate over pairs [3,n], as `paired_rate` of the logarithms.

    Infinite and without bounds as `paired_change`; also without bounds if there is no event after.
    """
    a, b = pooled_rate(*before), pooled_rate(*after)
    if not (a.known and b.known):
        return NA
    if a.value == 0.0 or b.value == 0.0:
        change = -1.0 if a.value else math.inf if b.value else 0.0
        return Figure(change, math.nan, math.nan)
    log_a, log_b = (Figure(*map(math.log, (f.value, f.low, f.high))) for f in (a, b))
    parts = _contributions(before, a) / a.value, _contributions(after, b) / b.value
    found = _difference(log_a, log_b, *parts, _normal(before, after))
    return Figure(*map(math.expm1, (found.value, found.low, found.high)))


# ---- inside ----


def _weights(tally: Array) -> Array:
    return tally[2] if len(tally) > 2 else np.ones(tally.shape[1])


def _normal(before: Array, after: Array) -> bool:
    """Whether the difference of the two rates is approximately normal.

    That needs events and samples with an event, since events of one sample are not independent.
    """
    y, w = (np.concatenate(both) for both in ((before[0], after[0]), (_weights(before), _weights(after))))
    enough_events = float((w * y).sum()) ** 2 >= NORMAL_EVENTS * float((w**2 * y).sum())
    return enough_events and effective(w * y) >= NORMAL_SAMPLES


def _contributions(tally: Array, rate: Figure) -> Array:
    """[n] the contribution of each sample to the error of a pooled rate."""
    w = _weights(tally)
    return np.asarray(w * (tally[0] - rate.value * tally[1]) / (w * tally[1]).sum())


def _difference(a: Figure, b: Figure, part_a: Array, part_b: Array, normal: bool) -> Figure:
    """b - a with its bounds, from the contributions of each pair to the errors of a and b ([n] each)."""
    value = b.value - a.value
    if normal:
        reach = Z * float(np.linalg.norm(part_b - part_a)) * math.sqrt(len(part_a) / (len(part_a) - 1))
        return Figure(value, value - reach, value + reach)
    scatter = np.ptp(part_a) > 0.0 and np.ptp(part_b) > 0.0
    correlation = float(np.corrcoef(part_a, part_b)[0, 1]) if scatter else 0.0
    if len(part_a) < NORMAL_SAMPLES:  # too few pairs to show that they agree
        correlation = min(correlation, 0.0)
    sides = (b.value - b.low, a.high - a.value), (b.high - b.value, a.value - a.low)
    down, up = (math.sqrt(max(p**2 + q**2 - 2.0 * correlation * p * q, 0.0)) for p, q in sides)
    return Figure(value, value - down, value + up)


def _known(values: Sequence[float] | Array) -> Array:
    data = np.asarray(values, np.float64)
    return data[~np.isnan(data)]


def _change(before: Array, after: Array, axis: int = -1) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):  # a resample may have only zeros
        return np.asarray(after.mean(axis=axis) / before.mean(axis=axis) - 1.0)


def _ratio(sums: Array, counts: Array, axis: int = -1) -> Array:
    return np.asarray(sums.sum(axis=axis) / counts.sum(axis=axis))


def _bootstrap(samples: tuple[Array, ...], statistic: Callable[..., Any], seed: int) -> Figure:
    """BCa over the common index of the samples; percentiles if BCa is not defined."""
    count = len(samples[0])
    if count == 0:
        return NA
    value = float(statistic(*samples))
    if all(np.ptp(s) == 0.0 for s in samples):
        return Figure(value, *[value if count > 1 else math.nan] * 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # DegenerateDataWarning: handled below
        found = stats.bootstrap(
            samples,
            statistic,
            paired=True,
            vectorized=True,
            n_resamples=RESAMPLES,
            batch=max(1, MAX_RESAMPLED_VALUES // count),
            confidence_level=CONFIDENCE,
            method="BCa",
            rng=np.random.default_rng(seed),
        )
    if not np.isfinite(found.bootstrap_distribution).all():
        return Figure(value, math.nan, math.nan)
    bounds = found.confidence_interval
    if np.isnan(bounds).any():
        tail = 50.0 * (1.0 - CONFIDENCE)
        bounds = np.percentile(found.bootstrap_distribution, [tail, 100.0 - tail])
    return Figure(value, *map(float, bounds))


def _tango(gained: int, lost: int, count: int, z: float) -> Figure:
    """Score interval of (gained - lost) / count: the differences d that a score test does not reject.

    Tango, Statistics in Medicine 17 (1998) 891-908, equation (10) for the variance under d.
    """
    if count == 0:
        return NA
    value = (gained - lost) / count

    def score(d: float) -> float:
        """(gained - lost - n d) over its standard deviation when d is the truth."""
        b = -gained - lost + (2 * count - gained + lost) * d
        c = -lost * d * (1.0 - d)
        root = math.sqrt(max(b * b - 8.0 * count * c, 0.0))
        # the larger root of 2 n q^2 + b q + c, without cancellation: P(yes to no) under d
        q = -2.0 * c / (b + root) if b > 0.0 else (root - b) / (4.0 * count)
        variance = count * (2.0 * q + d * (1.0 - d))
        off = gained - lost - count * d
        return off / math.sqrt(variance) if variance > 0.0 else math.copysign(math.inf, off) if off else 0.0

    edge = 1.0 - 1e-9  # at -1 and 1 the variance is 0
    low = -1.0 if value <= -edge else brentq(lambda d: score(d) - z, -edge, value)
    high = 1.0 if value >= edge else brentq(lambda d: score(d) + z, value, edge)
    return Figure(value, float(low), float(high))
