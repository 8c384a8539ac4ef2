"""A summary counts what it is from, pools nothing, and shows NA as NA."""

from __future__ import annotations

import json
from dataclasses import replace

from run_rows import BETTER, CASE, UNITS, cell, failed

from cosim.report.figures import measures
from cosim.report.summary import summarize


def rows(*cells: list) -> list:
    return [found for one in cells for _, found in one]


def test_only_ok_episodes_enter_a_figure_and_the_others_are_counted() -> None:
    driven = rows(cell("idm", 4, columns={"crashed": [True, False, False, False]}))
    driven += [failed(replace(CASE, seed=200_004)), failed(replace(CASE, seed=200_005), "timeout")]
    found = summarize(driven, UNITS, BETTER)
    assert found["status"] == {"ok": 4, "sim_crash": 1, "timeout": 1, "bad_input": 0}
    group = found["groups"][0]
    assert (group["episodes"], group["ok"]) == (6, 4)
    crashes = group["rates"]["collision_rate"]
    assert (crashes["value"], crashes["hits"], crashes["n"]) == (0.25, 1, 4)
    assert crashes["rule_of_three"] is None


def test_policies_presets_drivers_and_behaviours_are_never_pooled() -> None:
    driven = rows(
        cell("idm", 2),
        cell("vfn-p", 2),
        cell("idm", 2, preset="guarded"),
        cell("idm", 2, driver_model="mobil"),
        cell("idm", 2, behavior="aggressive"),
        cell("idm", 2, penetration=0.2),
        cell("idm", 2, svo_deg=90.0),
        cell("idm", 2, duration=20.0),  # no column of the rows tells this one apart, its cell does
    )
    found = summarize(driven)
    assert [group["episodes"] for group in found["groups"]] == [2] * 8
    assert len({group["cell"] for group in found["groups"]}) == 8


def test_what_does_not_apply_is_null_and_never_zero() -> None:
    driven = rows(cell("idm", 3, columns={"mission_success": [None] * 3, "dt_mission_m": [None] * 3}))
    group = summarize(driven, UNITS, BETTER)["groups"][0]
    success, distance = group["rates"]["mission_success_rate"], group["means"]["dt_mission_m"]
    assert (success["value"], success["hits"], success["n"], success["na"]) == (None, None, 0, 3)
    assert success["rule_of_three"] is None
    assert (distance["value"], distance["n"], distance["na"]) == (None, 0, 3)


def test_a_mean_over_some_episodes_says_over_how_many() -> None:
    driven = rows(cell("vfn-p", 4, columns={"veto_rate": [0.1, None, 0.3, None]}))
    found = summarize(driven, UNITS, BETTER)["groups"][0]["means"]["veto_rate"]
    assert (found["value"], found["n"], found["na"], found["unit"]) == (0.2, 2, 2, "share")


def test_near_misses_are_pooled_over_vehicle_hours() -> None:
    """12 in 3 hours, whatever the episodes' own rates are; an episode of an earlier version has none."""
    columns = {
        "near_misses_ttc": [2, 10, None],
        "vehicle_hours": [2.0, 1.0, None],
        "av_near_misses_ttc": [None, 1, None],
        "av_hours": [0.0, 0.5, None],
    }
    (group,) = summarize([r for _, r in cell("idm", 3, columns=columns)])["groups"]
    found = group["incidences"]
    assert set(found) == {"av_near_misses_ttc_per_av_hour", "near_misses_ttc_per_vehicle_hour"}
    all_of_them = found["near_misses_ttc_per_vehicle_hour"]
    assert (all_of_them["value"], all_of_them["events"], all_of_them["exposure"]) == (4.0, 12, 3.0)
    assert (all_of_them["n"], all_of_them["na"]) == (2, 1)
    assert all_of_them["low"] < 4.0 < all_of_them["high"]
    assert found["av_near_misses_ttc_per_av_hour"]["value"] == 2.0
    assert group["means"]["near_misses_ttc"]["value"] == 6.0


def test_nothing_crashed_says_what_that_bounds() -> None:
    group = summarize(rows(cell("idm", 30)))["groups"][0]
    assert group["rates"]["collision_rate"]["rule_of_three"] == 0.1


def test_episodes_that_must_not_be_compared_are_counted_with_their_reasons() -> None:
    why = ['["9 vehicles found no room"]', '["4 vehicles found no room"]', "[]"]
    columns = {"comparable": [False, False, True], "not_comparable_because": why}
    group = summarize(rows(cell("idm", 3, columns=columns)))["groups"][0]
    assert group["not_comparable"] == 2
    assert group["not_comparable_because"] == {"n vehicles found no room": 2}


def test_a_summary_is_json_and_the_same_every_time() -> None:
    driven = rows(cell("idm", 5, columns={"dt_av_m": [1.0, 5.0, 2.0, 4.0, 3.0]}))
    assert json.dumps(summarize(driven), allow_nan=False) == json.dumps(summarize(driven), allow_nan=False)
    assert json.loads(json.dumps(summarize([]), allow_nan=False))["groups"] == []


def test_a_new_metric_has_its_figure_without_being_listed() -> None:
    driven = rows(cell("idm", 2, columns={"late": [True, False], "noise_db": [60, 61.5]}))
    known = measures(driven, {"noise_db": "dB"}, {"noise_db": "lower"})
    assert known["late_rate"].is_rate
    assert (known["noise_db"].unit, known["noise_db"].better) == ("dB", "lower")
    assert "seed" not in known
    assert "steps" not in known


def test_wall_times_stand_apart_from_what_repeats() -> None:
    group = summarize(rows(cell("idm", 2)))["groups"][0]
    assert "total_s" in group["timings"]
    assert "total_s" not in group["means"]
