"""Claims are read from files; what is wrong with one is said in a sentence with file, field and value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cosim.errors import BadInput
from cosim.report.figures import INCIDENCES, RATES
from research import schema
from research.schema import Condition
from tests.research.claims import SMALL, claim, written

CLAIMS = [schema.read(schema.FOLDER / f"{name}.yaml") for name in schema.names()]
OF_THE_CAR = (
    "forced_entry",
    "humans",
    "label_free",
    "penetration",
    "saturated",
    "saturated_car",
    "saturated_junctions",
    "saturated_v2v",
    "svo",
    "yielding_delay",
    "yielding_junctions",
    "yielding_safety",
)
EVERYBODY = ("total_delay_s", "total_delay_av_s", "total_delay_hv_s", "longest_wait_s")
MEANS = ("dt_mean_m", "dt_av_m", "dt_hv_m", "dt_mission_m", "hard_brakings_av", *EVERYBODY)


@pytest.mark.parametrize("one", CLAIMS, ids=lambda one: one.name)
def test_a_shipped_claim_is_judged_on_seeds_that_nothing_was_tuned_on(one: schema.Claim) -> None:
    for scenario in one.scenarios:
        seeds = one.seeds_of(scenario)
        assert seeds.start >= 300_000


@pytest.mark.parametrize("one", CLAIMS, ids=lambda one: one.name)
def test_a_shipped_claim_names_figures_that_there_are_and_one_preset(one: schema.Claim) -> None:
    assert set(one.metrics) <= {*RATES, *INCIDENCES, *MEANS}
    assert {case.preset for case in one.cases.values()} == {
        "lawful" if one.name in OF_THE_CAR else "unguarded"
    }


def test_table_3_drives_six_approaches_and_five_floors_in_both_cells_and_demands() -> None:
    (one,) = schema.chosen(["table3"])
    assert len(one.cases) == 5 * 2 * 2 * 11
    assert {case.errors for case in one.cases.values()} == {None, "stress"}
    assert {case.demand for case in one.cases.values()} == {("dense",), ("contested",)}
    assert {case.behavior for case in one.cases.values()} == {"mixed"}
    assert one.published["merge"]["vfn-p"] == 1.04


def test_an_arm_is_options_over_those_of_all_arms_in_every_condition(tmp_path: Path) -> None:
    one = claim(
        tmp_path, matrix={"errors": ["none", "stress"]}, floors={"egoist": {"policy": "idm", "svo": 0}}
    )
    assert [c.text for c in one.conditions] == ["errors none"] * 2 + ["errors stress"] * 2
    case = one.cases[Condition("exit", (("errors", "stress"),)), "egoist"]
    assert (case.what, case.errors, case.policy, case.svo_deg) == ("exit", "stress", "idm", 0.0)
    assert (case.demand, case.preset, case.seed) == (("contested",), "unguarded", 300_000)


def test_a_scenario_may_have_more_seeds(tmp_path: Path) -> None:
    one = claim(tmp_path, seeds={"first": 300_000, "count": 40, "more": {"exit": 50}})
    assert (len(one.seeds_of("merge")), len(one.seeds_of("exit"))) == (40, 50)


def test_what_the_file_defines_has_a_digest_and_a_comment_changes_nothing(tmp_path: Path) -> None:
    path = written(tmp_path)
    before = schema.read(path).digest
    path.write_text("# why\n" + path.read_text())
    assert schema.read(path).digest == before
    assert claim(tmp_path, holds="somewhere").digest != before


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sentense": "x"}, "sentense='x': unknown field, did you mean 'sentence'?"),
        ({"scenarios": ["merge", "marge"]}, "scenarios='marge': unknown, did you mean 'merge'?"),
        ({"arms": {"rule": {"polcy": "idm"}, "idm": {}}}, "arms.rule.polcy='idm': unknown field"),
        ({"arms": {"rule": {"policy": "idmm"}, "idm": {}}}, "arms.rule.policy='idmm': unknown policy"),
        ({"arms": {"rule": {"svo": 10}, "idm": {}}}, "arms.rule.policy: is missing"),
        ({"options": {"svo": 100}}, "options.svo=100: a number from 0 to 90 is needed"),
        ({"matrix": {"errors": ["loud"]}}, "matrix.errors='loud'"),
        ({"matrix": {"policy": ["idm"]}}, "arms.rule.policy: is set by the matrix already"),
        ({"compare": {"arm": "rule", "against": "idn"}}, "compare='idn': unknown, did you mean 'idm'?"),
        ({"primary": {"metric": "x", "direction": "less"}}, "primary.direction='less': must be one of lower"),
        ({"test": "anova"}, "test='anova': must be one of mcnemar, signed_rank"),
        ({"seeds": {"first": 200_000, "count": 40}}, "seeds.first=200000: the seeds of a claim start at"),
        ({"power": {"smallest": 0.1, "pairs": 41}}, "power.pairs=41: must be between 1 and 40, the number"),
        ({"pool": ["demand"]}, "pool='demand': unknown"),
        ({"power": {"smallest": 0.0, "pairs": 4}}, "power.smallest=0.0: must be more than 0"),
        ({"published": {"merge": {"nobody": 1.0}}}, "published.merge='nobody': unknown"),
        ({"front": ["dt_av_m"]}, "front='dt_av_m': two metrics or more are needed"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_what_is_wrong_is_said_with_file_field_and_value(
    changes: dict[str, Any], said: str, tmp_path: Path
) -> None:
    with pytest.raises(BadInput) as error:
        claim(tmp_path, **changes)
    assert str(error.value).startswith(f"{tmp_path / 'small.yaml'}: {said}")


def test_a_claim_that_is_not_there_is_named_with_the_nearest(tmp_path: Path) -> None:
    written(tmp_path)
    with pytest.raises(BadInput, match="NAME='smal': unknown, did you mean 'small'"):
        [*schema.chosen(["smal"], tmp_path)]
    assert [one.sentence for one in schema.chosen([], tmp_path)] == [SMALL["sentence"]]
