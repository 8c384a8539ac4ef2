"""Intervals agree with published values, cover what they promise, and never make a 0 of an NA."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from benchmarks.behaviors import median_of_blocks
from cosim.report.statistics import (
    Figure,
    discordant,
    grouped_mean,
    holm,
    mcnemar,
    mean,
    paired_change,
    paired_mean,
    paired_rate,
    paired_rate_change,
    paired_share,
    pooled_rate,
    power,
    quantile,
    rate,
    rule_of_three,
    share,
    signed_rank,
    widened,
)

Z = 1.959963984540054


def test_wilson_keeps_its_width_when_nothing_happened() -> None:
    found = share(0, 50)
    assert (found.value, found.low) == (0.0, 0.0)
    assert found.high == pytest.approx(Z * Z / (50 + Z * Z))  # Wilson's formula at 0 hits
    some = share(3, 10)
    assert (some.low, some.high) == pytest.approx((0.1078, 0.6032), abs=5e-5)


def test_no_episode_gives_no_share() -> None:
    found = share(0, 0)
    assert not found.known
    assert found.document() == {"value": None, "low": None, "high": None}
    assert found.text(1) == "-"


def test_rule_of_three_bounds_what_was_never_seen() -> None:
    assert rule_of_three(60) == 0.05
    # at the bound, seeing nothing in 60 trials happens about one time in twenty
    assert (1 - rule_of_three(60)) ** 60 == pytest.approx(0.05, abs=0.005)
    assert rule_of_three(2) == 1.0
    assert math.isnan(rule_of_three(0))


def test_poisson_rate_agrees_with_garwoods_table() -> None:
    found = rate(10, 1.0)
    assert (found.low, found.high) == pytest.approx((4.795, 18.390), abs=1e-3)
    assert rate(0, 2.0).low == 0.0


def test_difference_of_paired_shares_agrees_with_published_example() -> None:
    """Airway hyper-responsiveness before and after transplantation (Bentur et al. 2009; Fagerland,
    Lydersen, Laake 2014): of 21 children 7 got better and 1 worse; Tango -0.517 to -0.026, p 0.070."""
    before = [True] * 8 + [False] * 13
    after = [True] + [False] * 7 + [True] + [False] * 12
    assert discordant(before, after) == (7, 1)
    found = paired_share(before, after)
    assert found.value == pytest.approx(-6 / 21)
    assert (found.low, found.high) == pytest.approx((-0.517, -0.026), abs=5e-4)
    assert mcnemar(7, 1) == pytest.approx(2 * (1 + 8) / 2**8)


def test_pairs_that_never_differ_still_leave_doubt() -> None:
    found = paired_share([False] * 20, [False] * 20)
    bound = Z * Z / (20 + Z * Z)  # Tango's interval in closed form when no pair is discordant
    assert (found.low, found.value, found.high) == pytest.approx((-bound, 0.0, bound))
    assert mcnemar(0, 0) == 1.0


def test_ranks_of_differences_by_wilcoxon_and_many_tests_by_holm() -> None:
    assert signed_rank(range(6), [k + 1 + k**2 for k in range(6)]) == pytest.approx(2 / 2**6)
    assert signed_rank([1.0, 2.0, math.nan], [1.0, 2.0, 5.0]) == 1.0
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_the_power_of_a_test_follows_from_the_width_of_the_interval() -> None:
    """An effect of 2.8 standard errors is found with 80 %; without error always."""
    one = Figure(0.3, 0.3 - Z, 0.3 + Z)  # a standard error of 1
    assert power(2.8, one) == pytest.approx(0.80, abs=2e-3)
    assert power(-2.8, one) == power(2.8, one)
    assert power(2.8, one, tests=20) == pytest.approx(0.41, abs=0.01)
    assert power(1.0, Figure(0.0, 0.0, 0.0)) == 1.0
    assert math.isnan(power(1.0, Figure(0.0, math.nan, math.nan)))


def test_intervals_that_hold_together_are_wider() -> None:
    assert widened(1) == pytest.approx(1.0)
    assert widened(20) * Z == pytest.approx(3.023, abs=1e-3)  # 0.05 / 20, both sides


def test_interval_of_paired_shares_is_symmetric_and_stays_within_one() -> None:
    for gained in range(7):
        for lost in range(7 - gained):
            before = [False] * gained + [True] * lost + [False] * (6 - gained - lost)
            after = [True] * gained + [False] * lost + [False] * (6 - gained - lost)
            there, back = paired_share(before, after), paired_share(after, before)
            assert -1.0 <= there.low <= there.value <= there.high <= 1.0
            assert (there.low, there.high) == pytest.approx((-back.high, -back.low), abs=1e-6)


def test_interval_of_paired_shares_covers_the_truth() -> None:
    """Exactly, by summing over all outcomes of 25 pairs of which 8 % get worse and 4 % better."""
    n, worse, better = 25, 0.08, 0.04
    covered = total = 0.0
    for gained in range(n + 1):
        for lost in range(n + 1 - gained):
            chance = stats.multinomial.pmf([gained, lost, n - gained - lost], n, [better, worse, 0.88])
            if chance < 1e-7:
                continue
            before = [False] * gained + [True] * lost + [False] * (n - gained - lost)
            after = [True] * gained + [False] * lost + [False] * (n - gained - lost)
            found = paired_share(before, after)
            total += chance
            covered += chance * (found.low <= better - worse <= found.high)
    assert total == pytest.approx(1.0, abs=1e-4)
    assert 0.94 <= covered <= 0.99


def test_bootstrap_of_a_bell_curve_is_students_interval() -> None:
    values = np.random.default_rng(1).normal(10.0, 2.0, 400)
    found = mean(values)
    student = stats.t.interval(0.95, 399, values.mean(), stats.sem(values))
    assert found.value == values.mean()
    assert (found.low, found.high) == pytest.approx(student, abs=0.04)


def test_bootstrap_reaches_further_where_the_tail_is() -> None:
    values = np.random.default_rng(2).exponential(1.0, 60)
    found = mean(values)
    assert found.high - found.value > 1.15 * (found.value - found.low)


def test_bootstrap_of_five_values_promises_too_much() -> None:
    """docs/explanation/statistics.md warns of it: four times in five, not nineteen in twenty."""
    rng = np.random.default_rng(0)
    found = [mean(rng.normal(size=5)) for _ in range(100)]
    assert 0.7 < sum(f.low <= 0.0 <= f.high for f in found) / 100 < 0.9


def test_bootstrap_is_the_same_every_time() -> None:
    values = np.random.default_rng(3).normal(size=30)
    assert mean(values, seed=7) == mean(values, seed=7)
    assert mean(values, seed=7) != mean(values, seed=8)


def test_missing_values_are_left_out_of_a_mean() -> None:
    assert mean([1.0, math.nan, 3.0]) == mean([1.0, 3.0])
    assert not mean([math.nan, math.nan]).known
    assert not mean([]).known


def test_one_value_has_no_interval_and_equal_values_no_width() -> None:
    one = mean([4.0])
    assert one.value == 4.0
    assert math.isnan(one.low)
    assert one.text(1) == "4.0"
    assert mean([2.0, 2.0, 2.0]) == Figure(2.0, 2.0, 2.0)


def test_pairing_removes_what_both_have_in_common() -> None:
    rng = np.random.default_rng(4)
    traffic = rng.normal(500.0, 100.0, 50)  # the seed decides most of it
    before, after = traffic, traffic - 5.0 + rng.normal(0.0, 2.0, 50)
    found = paired_mean(before, after)
    assert found.low < -5.0 < found.high < 0.0
    assert found.high - found.low < 0.1 * (mean(after).high - mean(after).low)


def test_a_pair_with_a_missing_side_does_not_count() -> None:
    found = paired_mean([1.0, math.nan, 3.0, 5.0], [2.0, 9.0, math.nan, 7.0])
    assert found.value == pytest.approx(1.5)


def test_the_interval_of_a_mean_of_groups_is_that_of_the_means_of_equal_groups() -> None:
    values = np.random.default_rng(0).normal(size=30)
    alone, twice = mean(values), grouped_mean([*values, *values], [*range(30), *range(30)])
    assert (twice.value, twice.low, twice.high) == pytest.approx((alone.value, alone.low, alone.high))
    assert mean([*values, *values]).high < twice.high
    unequal = grouped_mean([1.0, 3.0, 5.0, math.nan], ["a", "a", "b", "b"])
    assert unequal.value == pytest.approx(3.0)


def test_relative_change_is_of_the_means() -> None:
    found = paired_change([100.0, 200.0, 300.0], [110.0, 190.0, 330.0])
    assert found.value == pytest.approx(0.05)
    assert found.low < found.value < found.high


def test_change_from_nothing_has_no_bounds() -> None:
    found = paired_change([0.0, 0.0], [1.0, 2.0])
    assert found.value == math.inf
    assert math.isnan(found.high)
    assert found.document()["value"] is None
    assert paired_change([0.0, 0.0], [0.0, 0.0]) == Figure(0.0, 0.0, 0.0)
    assert math.isnan(paired_change([0.0, 0.0, 1.0], [1.0, 2.0, 3.0]).high)  # a resample may divide by 0


def test_a_pooled_rate_is_all_events_over_all_exposure() -> None:
    """Not the mean of rates: an episode of an hour counts for more than one of a minute."""
    found = pooled_rate([1, 9], [0.1, 0.9])
    assert found.value == pytest.approx(10.0)
    assert (found.low, found.high) == pytest.approx((4.795, 18.390), abs=1e-3)  # Garwood
    assert pooled_rate([0, 0], [1.0, 1.0]).high == pytest.approx(3.689 / 2.0, abs=1e-3)
    assert not pooled_rate([], []).known


def test_a_pooled_rate_of_events_that_come_together_is_less_certain() -> None:
    """Of ten episodes one had all 30: Pearson's chi-square is 270 with 9 degrees of freedom, factor 30."""
    even, together = pooled_rate([3] * 10, [1.0] * 10), pooled_rate([30] + [0] * 9, [1.0] * 10)
    assert (even.low, even.high) == pytest.approx((rate(30, 10.0).low, rate(30, 10.0).high))
    assert (together.low, together.high) == pytest.approx((rate(1, 1 / 3).low, rate(1, 1 / 3).high))


def test_the_interval_of_a_pooled_rate_covers_the_truth() -> None:
    rng, truth, inside = np.random.default_rng(0), 2.0, 0
    for _ in range(400):
        hours = rng.uniform(0.8, 1.2, 40)
        found = pooled_rate(rng.poisson(rng.gamma(1.0, truth * hours)), hours)
        inside += found.low <= truth <= found.high
    assert 0.91 <= inside / 400 <= 0.98


def test_the_difference_of_rates_is_of_pooled_rates_and_pairs_help() -> None:
    rng = np.random.default_rng(0)
    hours, busy = rng.uniform(0.8, 1.2, 60), rng.gamma(0.5, 40.0, 60)
    before = np.array([np.round(busy), hours])
    after = np.array([np.round(busy) + 2, hours])
    found = paired_rate(before, after)
    assert found.value == pytest.approx(120.0 / hours.sum())
    assert 0.0 < found.low < found.value < found.high < 3.0
    alone = pooled_rate(*before)
    assert found.high - found.low < 0.2 * (alone.high - alone.low)
    change = paired_rate_change(before, after)
    assert change.value == pytest.approx(120.0 / before[0].sum())
    assert 0.0 < change.low < change.value < change.high


def test_three_pairs_that_agree_are_no_proof_that_pairs_do() -> None:
    before = np.array([[1.0, 3.0, 2.0], [0.2, 0.2, 0.2]])
    after = before + np.array([[1.0], [0.0]])
    found, alone = paired_rate(before, after), pooled_rate(*before)
    assert found.high - found.low > alone.high - alone.low


def test_the_difference_of_a_few_events_keeps_the_doubt_of_both_rates() -> None:
    """Nothing on either side in 10 hours: each may be 0.37 an hour."""
    nothing = np.array([np.zeros(10), np.ones(10)])
    found = paired_rate(nothing, nothing)
    assert (found.value, found.low, found.high) == pytest.approx((0.0, -0.3689, 0.3689), abs=1e-4)
    assert paired_rate_change(nothing, nothing).value == 0.0
    assert paired_rate_change(nothing, nothing + 1.0).value == math.inf


def test_quantile_lies_between_its_order_statistics() -> None:
    values = [float(v) for v in range(1, 102)]
    found = quantile(values, 0.5)
    assert found == Figure(51.0, 41.0, 61.0)
    # the 41st and the 61st smallest of 101 hold the median between them in 95 of 100 samples
    assert stats.binom.cdf(60, 101, 0.5) - stats.binom.cdf(40, 101, 0.5) == pytest.approx(0.954, abs=1e-3)


def test_median_resamples_whole_blocks() -> None:
    """Two blocks of equal values each: the median's interval spans them, however many values they have."""
    samples = [(0, 1.0)] * 50 + [(1, 2.0)] * 49
    found = median_of_blocks(samples)
    assert (found.low, found.value, found.high) == (1.0, 1.0, 2.0)
