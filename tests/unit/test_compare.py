"""`cosim compare`: equal traffic is paired, thresholds say what they say, exit codes are the verdict."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from junitparser import Error, Failure, JUnitXml, Skipped
from run_rows import CASE, begin, cell, failed, row, write

from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.report.compare import FAILED, PASSED, SKIPPED, compare
from cosim.report.figures import RATES, Measure
from cosim.report.pairing import side
from cosim.report.statistics import Figure
from cosim.report.thresholds import ABSOLUTE, CHANGE, DIFFERENCE, parse

KNOWN = {
    **RATES,
    "dt_av_m": Measure("dt_av_m", "dt_av_m", "m", "higher"),
    "veto_rate": Measure("veto_rate", "veto_rate", "share", "lower"),
    "max_drac_mps2": Measure("max_drac_mps2", "max_drac_mps2", "m/s2", "lower"),
}
CRASHES = {"crashed": [True, True, False, False, False, False, False, False, False, False]}


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """idm never crashes in ten episodes, rash does twice and gets 5 % less far."""
    columns = {**CRASHES, "dt_av_m": [760.0] * 10}
    return write(tmp_path / "run", cell("idm", 10), cell("rash", 10, columns=columns))


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["compare", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


# ---- thresholds ----


@pytest.mark.parametrize(
    ("text", "kind", "bound", "limit"),
    [
        ("collision_rate > +0.5pp", DIFFERENCE, "value", 0.005),
        ("collision_rate.upper>+0.5 pp", DIFFERENCE, "upper", 0.005),
        ("collision_rate > 2%", ABSOLUTE, "value", 0.02),
        ("crashed > 2 %", ABSOLUTE, "value", 0.02),
        ("mission_success_rate < -10pp", DIFFERENCE, "value", -0.1),
        ("veto_rate > +5pp", DIFFERENCE, "value", 0.05),
        ("dt_av_m < -5%", CHANGE, "value", -0.05),
        ("dt_av_m.lower < -20m", DIFFERENCE, "lower", -20.0),
        ("dt_av_m < -20", DIFFERENCE, "value", -20.0),
        ("dt_av_m < 600 m", ABSOLUTE, "value", 600.0),
        ("max_drac_mps2 > +.5m/s2", DIFFERENCE, "value", 0.5),
        ("collision_rate > 0", ABSOLUTE, "value", 0.0),
    ],
)
def test_a_threshold_is_read(text: str, kind: str, bound: str, limit: float) -> None:
    found = parse(text, KNOWN)
    assert (found.kind, found.bound) == (kind, bound)
    assert found.limit == pytest.approx(limit)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("collison_rate > 2%", "did you mean 'collision_rate'"),
        ("collision_rate >= 2%", "write METRIC"),
        ("collision_rate", "write METRIC"),
        ("collision_rate.middle > 2%", "unknown bound .middle"),
        ("collision_rate > 2", "write % after"),
        ("collision_rate > +2", "write pp after"),
        ("collision_rate > 2pp", "write + or -"),
        ("collision_rate > +2%", "in pp"),
        ("dt_av_m > +2pp", "dt_av_m is in m"),
        ("dt_av_m > 2%", "with + or -"),
        ("dt_av_m > +2km", "unknown unit 'km'"),
    ],
)
def test_a_wrong_threshold_says_what_is_wrong(text: str, problem: str) -> None:
    with pytest.raises(BadInput) as caught:
        parse(text, KNOWN)
    assert problem in str(caught.value)
    assert text in str(caught.value)


def test_exactly_the_limit_does_not_fail() -> None:
    found = parse("collision_rate > 0.1%", KNOWN)
    assert not found.fails(1 / 1000)
    assert not found.fails(0.1 * 0.01)
    assert found.fails(2 / 1000)


def test_what_is_not_known_fails() -> None:
    nothing = Figure(0.0, float("nan"), float("nan"))
    found = parse("dt_av_m.lower < -5%", KNOWN)
    assert found.fails(found.of(nothing))


# ---- pairs ----


def test_pairs_are_of_equal_seeds_and_the_rest_is_counted(tmp_path: Path) -> None:
    a = write(tmp_path / "a", cell("idm", 10))
    b = write(tmp_path / "b", cell("idm", 10, first=200_004))
    group = compare(side(str(a)), side(str(b))).groups[0].group
    assert [x["seed"] for x, _ in group.pairs] == list(range(200_004, 200_010))
    assert [x["seed"] for x, _ in group.pairs] == [y["seed"] for _, y in group.pairs]
    assert group.unpaired == (4, 4)


def test_every_traffic_is_compared_by_itself(tmp_path: Path) -> None:
    folder = write(
        tmp_path / "run",
        *(cell(policy, 3, behavior=b) for policy in ("idm", "rash") for b in ("moderate", "aggressive")),
    )
    found = compare(side(f"{folder}:idm"), side(f"{folder}:rash"), ["collision_rate > +0pp"])
    assert [g.group.identity["behavior"] for g in found.groups] == ["moderate", "aggressive"]
    assert [check.status for check in found.checks] == [PASSED, PASSED]


def test_two_runs_of_several_policies_are_compared_policy_by_policy(tmp_path: Path) -> None:
    a = write(tmp_path / "a", cell("idm", 4), cell("rash", 4))
    b = write(tmp_path / "b", cell("rash", 4), cell("idm", 4), cell("new", 4))
    found = compare(side(str(a)), side(str(b)))
    assert [(g.group.a["policy"], g.group.b["policy"]) for g in found.groups] == [
        ("idm", "idm"),
        ("rash", "rash"),
    ]
    assert len(found.unmatched[1]) == 1
    assert "new" in found.unmatched[1][0]


def test_demands_of_one_name_in_two_folders_are_not_mixed_up(tmp_path: Path) -> None:
    demands = ("/x/a.rou.xml",), ("/y/a.rou.xml",)
    cells = [cell(policy, 2, demand=demand) for policy in ("idm", "rash") for demand in demands]
    folder = write(tmp_path / "run", *cells)
    found = compare(side(f"{folder}:idm"), side(f"{folder}:rash"))
    assert [len(g.group.pairs) for g in found.groups] == [2, 2]


def test_cells_that_cannot_be_distinguished_are_refused(tmp_path: Path) -> None:
    here, there = (cell("idm", 2, demand=(f"{place}/rush.rou.xml",)) for place in ("here", "there"))
    a, b = write(tmp_path / "a", here, there), write(tmp_path / "b", here)
    with pytest.raises(BadInput, match="two cells would be one"):
        compare(side(str(a)), side(str(b)))


@pytest.mark.parametrize(
    ("field", "of_a", "of_b"),
    [
        ("duration", 60.0, 30.0),
        ("warmup", 5.0, 0.0),
        ("mission", "m1", "none"),
        ("on_collision", "end", "continue"),
        ("preset", "lawful", "unguarded"),
        ("traffic", "as-is", "controlled"),
    ],
)
def test_runs_that_were_driven_otherwise_are_not_compared(
    tmp_path: Path, field: str, of_a: object, of_b: object
) -> None:
    values: tuple[dict[str, Any], ...] = ({field: of_a}, {field: of_b}, {field: of_a})
    a, b, like_a = (
        write(tmp_path / str(k), cell(policy, 3, **value))
        for k, (policy, value) in enumerate(zip(("idm", "rash", "rash"), values, strict=True))
    )
    with pytest.raises(BadInput, match=f"{field} is {of_a} in A, {of_b} in B"):
        compare(side(str(a)), side(str(b)), [])
    assert compare(side(str(a)), side(str(like_a)), []).exit_code == 0


def test_svo_may_differ_when_asked(tmp_path: Path) -> None:
    angles = (0.0, 90.0)
    folder = write(tmp_path / "run", cell("idm", 3), *(cell("vfn-p", 3, svo_deg=s) for s in angles))
    a, b = side(f"{folder}:idm"), side(f"{folder}:vfn-p")
    with pytest.raises(BadInput, match="--across svo_deg"):
        compare(a, b)
    found = compare(a, b, across=["svo_deg"])
    assert [g.group.b["svo_deg"] for g in found.groups] == [0.0, 90.0]
    assert len({g.group.name for g in found.groups}) == 2


def test_equal_drives_are_recognised_by_their_traces(tmp_path: Path) -> None:
    trace = {"trace_hash": ["a", "b", "c"]}
    a, b = (write(tmp_path / n, cell("idm", 3, columns=trace)) for n in "ab")
    assert compare(side(str(a)), side(str(b))).groups[0].group.identical == 3


def test_what_applies_to_one_side_only_is_left_out_and_counted(tmp_path: Path) -> None:
    late = {"dt_mission_m": [None, 510.0, 520.0, None]}
    early = {"dt_mission_m": [500.0, 500.0, None, None]}
    folder = write(tmp_path / "run", cell("idm", 4, columns=early), cell("rash", 4, columns=late))
    figure = compare(side(f"{folder}:idm"), side(f"{folder}:rash")).groups[0].figures["dt_mission_m"]
    assert (figure.n, figure.na, figure.na_on_both) == (1, 3, 1)
    assert figure.difference.value == 10.0


def test_one_pair_has_no_interval_and_shows_no_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / "run", cell("idm", 1), cell("rash", 1))
    _, out, _ = run(capsys, f"{folder}:idm", f"{folder}:rash")
    assert "1 pair (a single pair cannot show a difference)" in out
    assert "no difference shown" not in out
    assert " to " not in out.split("B - A")[1]
    assert ", p " not in out


# ---- near-misses ----


@pytest.fixture
def near(tmp_path: Path) -> Path:
    """Ten episodes of 0.5 vehicle hours each: 30 near-misses of idm, 40 of rash; 0 and 2 by DRAC."""
    counts = {"idm": ([3] * 10, [0] * 10), "rash": ([4, 5, 3, 4, 4, 4, 4, 3, 5, 4], [1, 1] + [0] * 8)}
    cells = [
        cell(
            policy,
            10,
            columns={
                "near_misses_ttc": ttc,
                "near_misses_drac": drac,
                "near_misses_pet": [0] * 10,
                "vehicle_hours": [0.5] * 10,
            },
        )
        for policy, (ttc, drac) in counts.items()
    ]
    return write(tmp_path / "near", *cells)


def test_near_misses_are_compared_per_vehicle_hour(near: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, f"{near}:idm", f"{near}:rash")
    assert code == 0
    lines = out.splitlines()
    (k,) = [k for k, line in enumerate(lines) if "near_misses_ttc_per_vehicle_hour" in line]
    assert re.split("  +", lines[k].strip())[1:] == ["6.0, 30 in 5 h", "8.0, 40 in 5 h", "+2.0"]
    assert re.split("  +", lines[k + 1].strip())[:2] == ["(4.0 to 8.6)", "(5.7 to 10.9)"]
    assert "near_misses_drac_per_vehicle_hour" in out
    assert "near_misses_pet" not in out  # none on either side


def test_the_text_fits_a_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A long name gives way to wide values; nothing but a folder's name is wider than 100 columns."""
    wide = {
        "mean_squared_wait_s2": [123_456.7, 98_765.4, 345_678.9, None],
        "longest_wait_s": [1.0, 2.0, 4.0, 7.0],
    }
    rare = {"av_involved_collisions": [9, 1, 0, 4], "av_km": [1.5, 2.0, 2.5, 3.0]}
    cells = [cell(name, 4, columns=wide | rare) for name in ("idm", "a-policy-whose-name-is-long")]
    folder = write(tmp_path / "run", *cells)
    limits = ("--fail-on", "mean_squared_wait_s2.upper > +250000", "--fail-on", "collision_rate > +20pp")
    _, out, _ = run(
        capsys, folder, "--baseline", "idm", "--candidate", "a-policy-whose-name-is-long", *limits
    )
    assert "crash_rate_per_million_km" in out
    assert "3 pairs" in out
    assert [line for line in out.splitlines() if len(line) > 100 and str(folder) not in line] == []


@pytest.mark.parametrize(
    ("threshold", "code"),
    [
        ("near_misses_ttc_per_vehicle_hour > 7.9 per vehicle-hour", 1),
        ("near_misses_ttc_per_vehicle_hour > 8", 0),
        ("near_misses_ttc_per_vehicle_hour.upper > 10", 1),  # Garwood: 40 (28.6 to 54.5) in 5 h
        ("near_misses_ttc_per_vehicle_hour.upper > 11", 0),
        ("near_misses_ttc_per_vehicle_hour > +1.9", 1),
        ("near_misses_ttc_per_vehicle_hour > +2", 0),
        ("near_misses_ttc_per_vehicle_hour.lower > +0", 1),  # the pairs show that it is more
        ("near_misses_ttc_per_vehicle_hour > +33%", 1),
        ("near_misses_ttc_per_vehicle_hour > +34%", 0),
        ("near_misses_drac_per_vehicle_hour.lower > +0", 0),  # two against none may be chance
        ("near_misses_pet_per_vehicle_hour.upper > +1", 0),
    ],
)
def test_near_misses_are_gated(
    near: Path, threshold: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, f"{near}:idm", f"{near}:rash", "--fail-on", threshold)[0] == code


# ---- verdicts ----


def test_exit_code_is_0_when_nothing_is_beyond_a_threshold(
    two: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(capsys, f"{two}:idm", f"{two}:rash", "--fail-on", "collision_rate > +20pp")
    assert code == 0
    assert "passed: 1 of 1 checks" in out
    assert "+20.0 pp" in out  # exactly at the limit, and shown


def test_exit_code_is_1_when_the_candidate_crashes_more(
    two: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = ("--fail-on", "collision_rate > +19.9pp", "--fail-on", "dt_av_m < -5%")
    code, out, _ = run(capsys, two, "--baseline", "idm", "--candidate", "rash", *limits)
    assert code == 1
    assert "FAIL  collision_rate > +19.9pp:  B - A is +20.0 pp" in out
    assert "pass  dt_av_m < -5%:  B / A - 1 is -5.0 %" in out
    back, _, _ = run(capsys, two, "--baseline", "rash", "--candidate", "idm", *limits)
    assert back == 0


def test_a_bound_of_the_interval_can_decide(two: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two crashes of ten are at most 50.98 %, by Wilson, and a difference of less than 56 points."""
    sides = (f"{two}:idm", f"{two}:rash", "--fail-on")
    assert run(capsys, *sides, "collision_rate.upper > 50.9%")[0] == 1
    assert run(capsys, *sides, "collision_rate.upper > 51.1%")[0] == 0
    assert run(capsys, *sides, "collision_rate.upper > +30pp")[0] == 1
    assert run(capsys, *sides, "collision_rate.upper > +56pp")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("{two}:idm", "{two}:rash", "--fail-on", "colision_rate > 1%"), "did you mean 'collision_rate'"),
        (("{two}:idm", "{two}:rahs"), "did you mean 'rash'"),
        (("{two}:idm", "{two}"), "choose one with DIR:POLICY: idm, rash"),
        (("{two}",), "--baseline and --candidate"),
        (("{two}:idm", "nowhere"), "no such run folder"),
        (("{two}:idm", "{two}:rash", "--fail-on", "veto_rate > 1%"), "NA in every compared episode"),
        (("{two}:idm", "{two}:rash", "--across", "svo"), "did you mean 'svo_deg'"),
        (("{two}:idm", "{two}:rash", "--junit", "{two}/no/j.xml"), "cannot write"),
    ],
)
def test_exit_code_is_2_for_bad_input(
    two: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], problem: str
) -> None:
    code, out, err = run(capsys, *(a.replace("{two}", str(two)) for a in arguments))
    assert (code, out) == (2, "")
    assert problem in err
    assert len(err.splitlines()) == 1


def test_exit_code_is_2_without_a_common_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = write(tmp_path / "a", cell("idm", 3))
    b = write(tmp_path / "b", cell("idm", 3, first=200_003))
    code, _, err = run(capsys, a, b)
    assert code == 2
    assert "A has 200000 to 200002, B has 200003 to 200005" in err


@pytest.mark.parametrize(("status", "expected"), [("sim_crash", 3), ("timeout", 3), ("bad_input", 2)])
def test_episodes_without_figures_leave_no_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], status: str, expected: int
) -> None:
    broken = replace(CASE, policy="rash", seed=200_009)
    cells = [cell("idm", 10), [*cell("rash", 9), (broken, failed(broken, status))]]
    folder = write(tmp_path / "run", *cells)
    junit = tmp_path / "junit.xml"
    arguments = (f"{folder}:idm", f"{folder}:rash", "--fail-on", "collision_rate > +0pp", "--junit", junit)
    code, out, _ = run(capsys, *arguments)
    assert code == expected
    assert "no verdict" in out
    assert f"{status} {broken.key} (rash, seed 200009)" in out
    errors = [case for suite in JUnitXml.fromfile(str(junit)) for case in suite if case.result]
    assert isinstance(errors[0].result[0], Error)
    assert broken.key in errors[0].system_err


@pytest.mark.parametrize("made", [begin, write])  # still driven; ended without the rows of some
def test_an_unfinished_batch_is_shown_as_far_as_it_is(
    made: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {"crashed": [True, False, False]}
    folder = made(tmp_path / "run", cell("idm", 10), cell("rash", 3, columns=columns), planned=10)
    sides = (folder, "--baseline", "idm", "--candidate", "rash")
    said = f"unfinished: 13 of 20 episodes of {folder} are driven, 3 pairs"
    code, out, _ = run(capsys, *sides)
    assert code == 0
    assert said in " ".join(out.split())
    assert "7 episodes of A have no partner and do not count" in out
    document = json.loads(run(capsys, *sides, "--json")[1])
    assert document["unfinished"] == [f"13 of 20 episodes of {folder} are driven"]
    assert document["groups"][0]["figures"]["collision_rate"]["hits_b"] == 1


def test_an_unfinished_batch_passes_no_gate_unless_that_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {"crashed": [True, False, False]}
    folder = begin(tmp_path / "run", cell("idm", 10), cell("rash", 3, columns=columns), planned=10)
    junit, markdown = tmp_path / "junit.xml", tmp_path / "comment.md"
    files = ("--junit", junit, "--markdown", markdown)
    sides = (f"{folder}:idm", f"{folder}:rash", *files, "--fail-on")
    code, out, _ = run(capsys, *sides, "collision_rate > +50pp")
    assert code == 2
    assert out.splitlines()[-1].startswith("no verdict: the batch is unfinished (--partial")
    assert "+33.3 pp" in out, "it is shown all the same"
    assert "**unfinished: 13 of 20 episodes" in markdown.read_text()
    (error,) = [c for suite in JUnitXml.fromfile(str(junit)) for c in suite if c.result]
    assert isinstance(error.result[0], Error)
    code, out, _ = run(capsys, *sides, "collision_rate > +50pp", "--partial")
    assert code == 0
    assert out.splitlines()[-1] == "passed: 1 of 1 checks, on a part of the episodes"
    assert not [c for suite in JUnitXml.fromfile(str(junit)) for c in suite if c.result]
    assert run(capsys, *sides, "collision_rate > +20pp", "--partial")[0] == 1


def test_failed_episodes_that_have_no_partner_are_left_out(tmp_path: Path) -> None:
    broken = replace(CASE, policy="rash", seed=200_099)
    cells = [cell("idm", 3), [*cell("rash", 3), (broken, failed(broken))]]
    folder = write(tmp_path / "run", *cells)
    assert compare(side(f"{folder}:idm"), side(f"{folder}:rash")).exit_code == 0


def test_a_figure_that_applies_nowhere_in_a_group_is_skipped_there(tmp_path: Path) -> None:
    none = {"mission_success": [None] * 3}
    cells = [cell(p, 3, what=w, columns=none if w == "highway" else None) for p in ("idm", "rash")
             for w in ("merge", "highway")]  # fmt: skip
    folder = write(tmp_path / "run", *cells)
    found = compare(side(f"{folder}:idm"), side(f"{folder}:rash"), ["mission_success_rate < -5pp"])
    assert [check.status for check in found.checks] == [PASSED, SKIPPED]
    assert found.exit_code == 0


def test_a_candidate_that_never_has_a_figure_fails_on_it(tmp_path: Path) -> None:
    """It never arrived, so its time of arrival is NA: that must not pass for being no slower."""
    columns = {"mission_time_s": [None] * 3}
    cells = cell("idm", 3, columns={"mission_time_s": [9.0, 8.0, 7.0]}), cell("rash", 3, columns=columns)
    folder = write(tmp_path / "run", *cells)
    found = compare(side(f"{folder}:idm"), side(f"{folder}:rash"), ["mission_time_s > +1"])
    assert [check.status for check in found.checks] == [FAILED]


def test_pairs_that_must_not_be_compared_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = {"comparable": [False, True, True]}
    folder = write(tmp_path / "run", cell("idm", 3), cell("rash", 3, columns=columns))
    _, out, _ = run(capsys, f"{folder}:idm", f"{folder}:rash")
    assert "1 pair with an episode that is not comparable" in out


@pytest.mark.parametrize("threshold", ["mission_success_rate < -10pp", "dt_mission_m < -5%"])
def test_a_guessed_mission_vehicle_feeds_no_gate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], threshold: str
) -> None:
    columns = {"mission_guessed": [False, True, True], "mission_vehicle": ["m", "v3", "v4"]}
    folder = write(tmp_path / "run", cell("idm", 3), cell("rash", 3, columns=columns))
    code, _, said = run(capsys, f"{folder}:idm", f"{folder}:rash", "--fail-on", threshold)
    assert code == 2
    assert "the mission vehicle of 2 pairs was guessed" in said
    assert "--mission ID" in said
    code, out, _ = run(capsys, f"{folder}:idm", f"{folder}:rash", "--fail-on", "dt_av_m < -5%")
    assert code == 0
    assert "2 pairs with a guessed mission vehicle" in out


# ---- files ----


def test_junit_is_read_by_a_real_parser(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    none = {"mission_success": [None] * 10}
    cells = [
        cell("idm", 10),
        cell("rash <&>", 10, columns=CRASHES),
        cell("idm", 10, what="highway", columns=none),
        cell("rash <&>", 10, what="highway", columns=none),
    ]
    folder, junit = write(tmp_path / "run", *cells), tmp_path / "junit.xml"
    limits = ("--fail-on", "collision_rate > +5pp", "--fail-on", "mission_success_rate < -5pp")
    code, _, _ = run(capsys, f"{folder}:idm", f"{folder}:rash <&>", *limits, "--junit", junit)
    assert code == 1
    read = JUnitXml.fromfile(str(junit))
    assert (read.tests, read.failures, read.errors, read.skipped) == (4, 1, 0, 1)
    cases = [case for suite in read for case in suite]
    assert len({(case.name, case.classname) for case in cases}) == 4  # one per threshold and group
    bad = [case for case in cases if case.result and isinstance(case.result[0], Failure)]
    assert bad[0].name == "collision_rate > +5pp"
    assert "rash <&>" in bad[0].classname
    for figure in ("+20.0 pp", "A 0.0 %", "B 20.0 %", "2/10", "p 0.5"):
        assert figure in bad[0].result[0].message
    skipped = [case for case in cases if case.result and isinstance(case.result[0], Skipped)]
    assert "highway" in skipped[0].classname


def test_markdown_is_a_table_that_text_cannot_break(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / "run", cell("idm", 10), cell("a|b<script>", 10, columns=CRASHES))
    file = tmp_path / "compare.md"
    sides = (f"{folder}:idm", f"{folder}:a|b<script>")
    run(capsys, *sides, "--fail-on", "collision_rate > +5pp", "--markdown", file)
    text = file.read_text()
    assert "<script>" not in text.replace(f"`{sides[1]}`", "")
    checks = [line for line in text.splitlines() if line.startswith("| ❌")]
    assert len(checks) == 1
    assert checks[0].replace("\\|", "").count("|") == 5  # four cells
    assert "`collision_rate > +5pp`" in checks[0]


def test_json_is_one_document_with_everything(two: Path, capsys: pytest.CaptureFixture[str]) -> None:
    limit = ("--fail-on", "collision_rate > +5pp", "--json")
    code, out, _ = run(capsys, f"{two}:idm", f"{two}:rash", *limit)
    found = json.loads(out)
    assert found["exit_code"] == code == 1
    figure = found["groups"][0]["figures"]["collision_rate"]
    assert (figure["hits_a"], figure["hits_b"], figure["n"]) == (0, 2, 10)
    assert figure["difference"]["value"] == pytest.approx(0.2)
    assert found["groups"][0]["figures"]["veto_rate"]["a"]["value"] is None
    assert found["checks"][0]["status"] == "failed"


def test_the_same_rows_give_the_same_verdict(two: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = run(capsys, f"{two}:idm", f"{two}:rash", "--json")
    assert run(capsys, f"{two}:idm", f"{two}:rash", "--json") == first


def test_a_run_without_a_manifest_can_be_compared(tmp_path: Path) -> None:
    folder = write(tmp_path / "run", cell("idm", 3), cell("rash", 3), manifest=False)
    found = compare(side(f"{folder}:idm"), side(f"{folder}:rash"), ["dt_av_m < -5%"])
    assert found.exit_code == 0


def test_a_failed_episode_bears_the_name_its_policy_gives_itself(tmp_path: Path) -> None:
    """`--policy best.safetensors` calls itself vfn-p once loaded; a crashed episode never got that far."""
    cases = [replace(CASE, policy="best.safetensors", seed=200_000 + k) for k in range(2)]
    rows = [(cases[0], row(cases[0], policy="vfn-p")), (cases[1], failed(cases[1]))]
    folder = write(tmp_path / "run", cell("idm", 2), rows)
    assert compare(side(f"{folder}:idm"), side(f"{folder}:vfn-p")).exit_code == 3


def test_everybodys_delay_is_gated_and_named_as_worse(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = [10.0 + 0.1 * k for k in range(10)]
    columns = {"mission_success": [False] * 10, "total_delay_s": late}
    later = {"total_delay_s": [1.05 * x for x in late]}
    folder = write(tmp_path / "run", cell("idm", 10, columns=columns), cell("kind", 10, columns=later))
    code, out, _ = run(capsys, f"{folder}:idm", f"{folder}:kind", "--fail-on", "total_delay_s > +2%")
    assert code == 1
    assert "  better: mission success +100.0 pp" in out
    assert "  worse: everybody's delay +0.52" in out
    assert "FAIL  total_delay_s > +2%:  B / A - 1 is +5.0 %" in out
    code, out, _ = run(capsys, f"{folder}:idm", f"{folder}:kind", "--json")
    group = json.loads(out)["groups"][0]
    assert [group["worse"][0].split(" +")[0], len(group["worse"])] == ["everybody's delay", 1]


def test_fewer_than_six_pairs_make_nothing_better_or_worse(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for pairs, word in ((5, "no difference shown"), (6, "worse")):
        late = [10.0 + 0.1 * k for k in range(pairs)]
        later = {"total_delay_s": [1.05 * x for x in late]}
        before = cell("idm", pairs, columns={"total_delay_s": late})
        folder = write(tmp_path / str(pairs), before, cell("kind", pairs, columns=later))
        _, out, _ = run(capsys, f"{folder}:idm", f"{folder}:kind")
        assert re.search(rf"  {word}: [^:]*everybody's delay", out)


def test_the_mission_figures_of_two_guessed_vehicles_are_no_pair(tmp_path: Path) -> None:
    guesses = {"mission_guessed": [True] * 3, "dt_mission_m": [100.0] * 3}
    other = guesses | {"mission_vehicle": ["r.7", "r.7", "r.8"], "dt_mission_m": [100.0, 100.0, 160.0]}
    folder = write(
        tmp_path / "run",
        cell("idm", 3, columns=guesses | {"mission_vehicle": ["r.7"] * 3}),
        cell("kind", 3, columns=other),
    )
    figures = compare(side(f"{folder}:idm"), side(f"{folder}:kind")).groups[0].figures
    assert (figures["dt_mission_m"].n, figures["dt_mission_m"].difference.value) == (2, 0.0)
    assert figures["dt_mean_m"].n == 3


def test_a_cell_without_a_common_seed_is_listed_beside_those_with_one(tmp_path: Path) -> None:
    merge, leave = CASE, replace(CASE, what="exit")
    both = [
        (replace(c, seed=200_000), row(replace(c, seed=200_000), scenario=c.what)) for c in (merge, leave)
    ]
    other = replace(leave, seed=200_009)
    a = write(tmp_path / "a", both[:1], both[1:])
    b = write(tmp_path / "b", both[:1], [(other, row(other, scenario="exit"))])
    found = compare(side(str(a)), side(str(b)))
    assert len(found.groups) == 1
    assert [len(cells) for cells in found.unmatched] == [1, 1]
    assert all("exit" in cells[0] for cells in found.unmatched)
