"""What made-up episodes with known answers say of a claim."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cosim.errors import BadInput
from cosim.report.statistics import mcnemar
from research.evaluate import Found, evaluate
from research.schema import Condition
from tests.research.claims import arms, claim, rows

NOTES = {"units": {"dt_mean_m": "m"}, "better": {"dt_mean_m": "higher"}}


def found(folder: Path, merge: Any, exit: Any, **changes: Any) -> Found:
    """The claim on the episodes of (rule, idm) in both scenarios."""
    of = {
        **{("merge", name): mine for name, mine in zip(("rule", "idm"), merge, strict=True)},
        **{("exit", name): mine for name, mine in zip(("rule", "idm"), exit, strict=True)},
        **{(scenario, "lane"): rows(range(40), 40) for scenario in ("merge", "exit")},
    }
    return evaluate(claim(folder, **changes), arms(of), NOTES)


SAVES = (rows([], 400), rows(range(100), 400))  # 25 points fewer
EQUAL = (rows(range(100), 400), rows(range(1, 101), 400))
FEW = (rows([], 20), rows([1, 2, 3], 20))


def test_a_claim_that_holds_in_every_condition_is_yes_with_its_effect(tmp_path: Path) -> None:
    one = found(tmp_path, SAVES, SAVES)
    assert one.verdict == "yes"
    assert [t.verdict for t in one.tested] == ["yes", "yes"]
    overall = one.overall["idm"]
    assert overall.n == 800
    assert overall.difference.value == pytest.approx(-0.25)
    assert overall.difference.high < -0.2


def test_one_condition_without_an_effect_of_interest_makes_it_no(tmp_path: Path) -> None:
    one = found(tmp_path, SAVES, EQUAL)
    assert [t.verdict for t in one.tested] == ["yes", "no"]
    assert one.verdict == "no"
    assert found(tmp_path, SAVES, EQUAL, holds="somewhere").verdict == "yes"


def test_too_few_episodes_resolve_nothing_and_say_which_power_they_had(tmp_path: Path) -> None:
    one = found(tmp_path, SAVES, FEW)
    assert [t.verdict for t in one.tested] == ["yes", "unresolved"]
    assert one.verdict == "unresolved"
    assert one.tested[1].power < 0.3
    assert one.tested[0].power > 0.95


def test_an_effect_the_other_way_is_no(tmp_path: Path) -> None:
    other = (SAVES[1], SAVES[0])
    assert found(tmp_path, other, other).verdict == "no"


def test_more_tests_need_a_narrower_interval_for_no(tmp_path: Path) -> None:
    same = (rows(range(10), 45), rows(range(1, 11), 45))
    assert found(tmp_path, same, same).tested[0].verdict == "unresolved"
    alone = {key: arm for key, arm in found(tmp_path, same, same).arms.items() if key[0].scenario == "merge"}
    assert evaluate(claim(tmp_path), alone, NOTES).verdict == "no"


def test_a_share_without_room_for_the_effect_cannot_say_no_but_its_opposite_can(tmp_path: Path) -> None:
    clean = (rows([], 400), rows([], 400))
    assert {t.verdict for t in found(tmp_path, clean, clean).tested} == {"unresolved"}
    assert {t.verdict for t in found(tmp_path, SAVES[::-1], SAVES[::-1]).tested} == {"no"}


def test_conditions_that_count_together_are_one_and_pairs_stay_in_their_traffic(tmp_path: Path) -> None:
    together = claim(tmp_path, matrix={"demand": ["dense", "contested"]}, pool=["demand"], options={})
    dense, contested = (Condition("merge", (("demand", name),)) for name in ("dense", "contested"))
    crashes = {(dense, "rule"): [], (dense, "idm"): [0], (contested, "rule"): [1], (contested, "idm"): [2]}
    made = arms({("merge", f"{k}"): rows(which, 40) for k, which in enumerate(crashes.values())})
    given = {
        key: replace(arm, definitions=key[0].text) for key, arm in zip(crashes, made.values(), strict=True)
    }
    (one,) = evaluate(together, given, NOTES).tested
    assert (one.condition, one.found.n) == (Condition("merge"), 80)
    assert one.p == mcnemar(2, 1)
    joined = evaluate(together, given, NOTES).arms[Condition("merge"), "rule"].definitions
    other = {key: replace(arm, definitions="others") for key, arm in given.items() if key[0] == contested}
    assert (
        evaluate(together, {**given, **other}, NOTES).arms[Condition("merge"), "rule"].definitions != joined
    )


def test_tests_are_corrected_together(tmp_path: Path) -> None:
    five, six = (rows([], 400), rows(range(5), 400)), (rows([], 400), rows(range(6), 400))
    one = found(tmp_path, five, six)
    assert [t.p for t in one.tested] == [mcnemar(5, 0), mcnemar(6, 0)] == [0.0625, 0.03125]
    assert [t.p_holm for t in one.tested] == [0.0625, 0.0625]


def test_a_mean_is_tested_by_signed_ranks(tmp_path: Path) -> None:
    farther = (rows([], 40, 110.0), rows([], 40, 100.0))
    one = found(tmp_path, farther, farther, **MEANS)
    assert one.verdict == "yes"
    assert one.overall["idm"].difference.value == pytest.approx(10.0)
    with pytest.raises(BadInput, match="test='mcnemar': dt_mean_m is not a share of episodes"):
        found(tmp_path, farther, farther, **{**MEANS, "test": "mcnemar"})


MEANS = {
    "primary": {"metric": "dt_mean_m", "direction": "higher"},
    "test": "signed_rank",
    "power": {"smallest": 5.0, "pairs": 40},
}


def test_ranks_alone_do_not_make_it_yes_if_the_mean_may_be_nothing(tmp_path: Path) -> None:
    """Most episodes gain a little, two lose much."""
    before = rows([], 40, 100.0)
    gained = [-40.0] * 2 + [3.0] * 38
    after = [{**row, "dt_mean_m": row["dt_mean_m"] + gain} for row, gain in zip(before, gained, strict=True)]
    changes = {**MEANS, "power": {"smallest": 1.0, "pairs": 40}}
    one = found(tmp_path, (after, before), (after, before), **changes).tested[0]
    assert one.p_holm < 0.05
    assert one.found.difference.low < 0.0 < one.found.difference.value
    assert one.verdict == "unresolved"


def test_the_pooled_interval_counts_traffic_once_that_two_conditions_share(tmp_path: Path) -> None:
    before = rows([], 40, 100.0)
    after = tuple({**row, "dt_mean_m": row["dt_mean_m"] + k % 7} for k, row in enumerate(before))
    one = found(tmp_path, (after, before), (after, before), **MEANS)
    both = {
        (Condition("merge", (("errors", level),)), name): arm
        for (_, name), arm in one.arms.items()
        for level in ("none", "stress")
    }
    shared, apart = replace(one, arms=both).overall["idm"], one.overall["idm"]
    assert shared.n == apart.n == 80
    assert shared.difference.value == apart.difference.value
    assert shared.difference.high > apart.difference.high


def test_a_figure_that_the_episodes_do_not_have_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="metric='dt_mean': no such figure, did you mean 'dt_mean_m'"):
        found(tmp_path, SAVES, SAVES, secondary=["dt_mean"])


def test_only_seeds_that_both_drove_to_the_end_are_pairs(tmp_path: Path) -> None:
    failed = tuple({**row, "status": "timeout"} if row["seed"] < 3 else row for row in SAVES[0])
    one = found(tmp_path, (failed, SAVES[1]), SAVES)
    assert [t.found.n for t in one.tested] == [397, 400]


def test_every_line_says_what_it_is_of_and_floors_are_not_tested(tmp_path: Path) -> None:
    lines = [*found(tmp_path, SAVES, EQUAL).lines()]
    own = [line for line in lines if not line.against]
    assert {line.arm for line in own} == {"rule", "idm", "lane"}
    assert {(line.arm, line.against) for line in lines if line.against} == {("rule", "idm")}
    assert {line.weights for line in own if line.arm == "rule"} == {"0123456789ab"}
    assert {(line.preset, line.errors, line.drivers) for line in lines} == {("unguarded", "none", "mixed")}
    crashes = next(line for line in own if (line.scenario, line.arm) == ("merge", "idm"))
    assert (crashes.figure, crashes.value, crashes.n, crashes.na) == ("collision_rate", 0.25, 400, 0)
    tested = [line for line in lines if line.p_holm is not None]
    assert [line.figure for line in tested] == ["collision_rate"] * 2
