"""A crash rate from tilted episodes has an interval that holds the truth, and a weight that is a ratio."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from benchmarks import estimate
from benchmarks.toy_crashes import KINDS, Toy
from cosim.errors import BadInput
from cosim.report import crash_rate
from cosim.report.figures import CRASHES, INCIDENCES
from cosim.report.statistics import effective, paired_rate, paired_rate_change, pooled_rate, rate
from cosim.scenario import tilt
from cosim.scenario.tilt import Tilt

RAISED = Tilt(dict.fromkeys(KINDS, 100.0))


def test_the_interval_holds_the_truth_of_a_toy() -> None:
    """400 estimates of 1,000 episodes each, of which brute force would see a crash in every fifth."""
    toy = Toy()
    found = [pooled_rate(*parts) for parts in zip(*toy.drive((400, 1000), RAISED, 7), strict=True)]
    truth = toy.truth()
    assert 0.90 <= np.mean([f.low <= truth <= f.high for f in found]) <= 0.98
    values = np.array([f.value for f in found])
    assert abs(values.mean() - truth) < 3.0 * values.std() / math.sqrt(len(values))
    assert (
        np.median([f.high - f.low for f in found]) < 2.0 * truth
    )  # +-100 %: brute force gives 25 times that


def test_the_paired_difference_and_change_hold_the_truth_of_a_toy() -> None:
    toys = Toy(), Toy(danger=0.6)
    sides = [zip(*toy.drive((400, 1000), RAISED, 7), strict=True) for toy in toys]
    pairs = [tuple(map(np.array, both)) for both in zip(*sides, strict=True)]
    was, now = (toy.truth() for toy in toys)
    for figure, truth in ((paired_rate, now - was), (paired_rate_change, now / was - 1.0)):
        found = [figure(*both) for both in pairs]
        assert 0.90 <= np.mean([f.low <= truth <= f.high for f in found]) <= 0.99


def test_without_a_tilt_the_rate_is_the_unweighted_one() -> None:
    toy = Toy(rates=(1e-2, 1e-2, 0.0))
    crashes, km, weights = toy.drive((4000,), Tilt(), 3)
    assert (weights == 1.0).all()
    found, plain = pooled_rate(crashes, km, weights), rate(int(crashes.sum()), km.sum())
    assert crashes.sum() > 20
    assert found.value == pytest.approx(plain.value)
    assert (found.low, found.high) == pytest.approx((plain.low, plain.high))


def test_no_crash_still_bounds_the_rate() -> None:
    found = pooled_rate([0.0] * 100, [0.01] * 100, [1.0] * 100)
    assert (found.value, found.low) == (0.0, 0.0)
    assert found.high == pytest.approx(rate(0, 1.0).high)
    heavier = pooled_rate([0.0] * 100, [0.01] * 100, [4.0] + [1.0] * 99)
    assert heavier.high > 3.8 * found.high
    assert not pooled_rate([], [], []).known


def test_one_crash_in_each_episode_keeps_a_width() -> None:
    found = pooled_rate([1.0] * 5, [1.0] * 5, [1.0] * 5)
    assert found.low < 0.5
    assert found.high > 2.0


def test_episodes_with_several_events_widen_the_interval() -> None:
    spread, bunched = [1.0] * 10 + [0.0] * 90, [10.0] + [0.0] * 99
    one, other = (pooled_rate(counts, [1.0] * 100, [1.0] * 100) for counts in (spread, bunched))
    assert one.value == other.value
    assert other.high - other.low > 2.0 * (one.high - one.low)


def test_many_events_of_one_pair_do_not_make_a_normal_difference() -> None:
    """Forty events of one episode on either side come together: nothing says how they scatter."""
    one = np.array([[40.0], [1.0]])
    found = paired_rate(one, np.array([[45.0], [1.0]]))
    assert found.value == 5.0
    assert found.low < -5.0 < 15.0 < found.high
    two = np.array([[40.0, 0.0], [1.0, 1.0]])
    assert paired_rate(two, two).low < 0.0


def test_effective_samples_count_equal_weights() -> None:
    assert effective([2.0] * 7) == pytest.approx(7.0)
    assert effective([1.0, 0.0, 0.0]) == pytest.approx(1.0)
    assert effective([]) == 0.0


def test_the_mean_weight_is_one() -> None:
    weights = Toy().drive((40_000,), RAISED, 5).weights
    assert weights.mean() == pytest.approx(1.0, abs=3.0 * weights.std() / 200.0)
    assert weights.max() <= 1.0 / RAISED.untilted


def test_a_tilt_is_written_as_it_is_read() -> None:
    found = tilt.read("hard_braking=30, cut_in=300")
    assert found.text() == "cut_in=300,hard_braking=30,during=1,untilted=0.1"
    assert tilt.read(found.text()) == found
    assert found.rate("cut_in", 1e-4) == pytest.approx(0.03)
    assert found.rate("cut_in", 0.1) == 0.5  # no trial becomes certain
    assert found.rate("cut_in", 0.7) == 0.7
    assert found.rate("red_light", 0.1) == 0.1
    assert tilt.log_ratio(0.1, 0.1, True) == 0.0


def test_a_second_error_has_a_factor_of_its_own_or_that_of_the_first_times_during() -> None:
    found = tilt.read("cut_in=30,inattention=2,inattention.second=900,during=10")
    assert found.rate("cut_in", 1e-4, True, True) == pytest.approx(0.03)
    assert found.rate("inattention", 1e-4, True, True) == pytest.approx(0.09)
    assert found.rate("inattention", 1e-4) == pytest.approx(2e-4)
    assert tilt.read("all.second=50").rate("stalled_car", 1e-4, False, True) == pytest.approx(5e-3)
    assert tilt.read("all.second=50").raises("stalled_car")
    assert tilt.case("cut_in", True, True) == tilt.case("cut_in", False, True) == "cut_in.second"


@pytest.mark.parametrize("text", ["cut_in", "cut_in=many", "cut_in=0.5", "untilted=0", "cut_in=nan"])
def test_a_tilt_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(BadInput, match="--tilt"):
        tilt.read(text)


def test_the_share_of_untilted_episodes_is_drawn_by_the_seed() -> None:
    drawn = [Tilt(untilted=0.25).drawn(seed) for seed in range(4000)]
    assert np.mean(drawn) == pytest.approx(0.75, abs=0.03)
    assert drawn == [Tilt(untilted=0.25).drawn(seed) for seed in range(4000)]


def test_the_errors_that_tell_most_are_raised_most() -> None:
    """Two kinds begin as often; crashes after one weigh ten times as much as after the other."""
    before = Tilt({"cut_in": 10.0, "hard_braking": 10.0, "stalled_car": 10.0})

    def row(kind: str, weight: float, crashes: int) -> dict[str, object]:
        return {
            "tilt_trials": json.dumps({kind: (1, 0.01)}),
            "weight": weight,
            "av_involved_collisions": crashes,
        }

    rows = [
        *[row("cut_in", 0.1, k < 5) for k in range(50)],
        *[row("hard_braking", 0.01, k < 5) for k in range(50)],
        *[row("stalled_car", 0.1, 0) for _ in range(50)],
    ]
    found = estimate.allotted(rows, before)
    factors = found.factors
    assert factors["cut_in"] / factors["hard_braking"] == pytest.approx(
        math.sqrt((5 * 0.01 + 0.5 * 0.00505) / (5 * 0.0001 + 0.5 * 0.00505))
    )
    assert 1.0 < factors["stalled_car"] < factors["cut_in"]  # none seen is not none
    begin = sum(factors[kind] / before.factors[kind] * 50 for kind in before.factors)
    assert begin == pytest.approx(estimate.FIRST_WITH * len(rows))
    assert estimate.allotted(rows[100:], before) is before
    rare = [{**one, "tilt_trials": json.dumps({"cut_in": (1, 0.5)})} for one in rows[:50]]  # a fifth begins
    assert estimate.allotted([*rare, *rows[50:]], before).factors["cut_in"] == before.factors["cut_in"]


@pytest.mark.parametrize("spread", [1.0, 4.0])
def test_as_many_episodes_as_are_said_to_be_needed_make_the_interval_as_wide(spread: float) -> None:
    """Weights alike, or half of them `spread` times the others."""

    def drawn(count: int) -> list[dict[str, Any]]:
        each = [{"av_involved_collisions": float(k % 25 < 2), "av_km": 5.0} for k in range(count)]
        return [row | {"weight": spread if k % 2 else 1.0} for k, row in enumerate(each)]

    few, crash = drawn(100), INCIDENCES[CRASHES]
    many = round(crash_rate.needed(few) / 50.0) * 50
    found = crash.figure(drawn(many))
    assert many > 150
    assert (found.high - found.low) / 2.0 == pytest.approx(
        crash_rate.USEFUL_HALF_WIDTH * found.value, rel=0.08
    )
    assert crash_rate.needed(drawn(many)) == pytest.approx(many, rel=0.2)
    assert math.isinf(crash_rate.needed([row | {"av_involved_collisions": 0.0} for row in few]))
