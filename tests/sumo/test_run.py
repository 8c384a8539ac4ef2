"""`cosim run` as a user meets it: one JSON document, exit codes, equal seeds, a user's own scenario."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import sumo_scenarios
from policy.agents import make

REQUIRED = """
    scenario demand policy preset driver_model seed steps crashed collisions av_caused_collisions teleports
    mission_success mission_time_s dt_mean_m dt_mission_m min_ttc_s vehicles_inserted
    vehicles_never_inserted trace_hash timings"""


def run(*arguments: str, expect: int = 0) -> subprocess.CompletedProcess[str]:
    """The command line in a fresh process, SUMO_HOME unset."""
    environment = {k: v for k, v in os.environ.items() if k != "SUMO_HOME"}
    done = subprocess.run(
        [sys.executable, "-m", "cosim.cli.main", "run", *arguments],
        capture_output=True,
        text=True,
        env=environment,
        timeout=300,
        check=False,
    )
    assert done.returncode == expect, done.stderr
    return done


def document(*arguments: str) -> dict[str, Any]:
    """The JSON document: exactly one on stdout."""
    result: dict[str, Any] = json.loads(run(arguments[0], "--json", *arguments[1:]).stdout)
    return result


@pytest.fixture(scope="session")
def a10kw() -> str:
    """The motorway interchange that the eclipse-sumo package ships."""
    import sumo

    return str(Path(sumo.__file__).parent / "tools" / "game" / "A10KW.sumocfg")


def test_the_document_has_every_promised_figure() -> None:
    found = document("merge", "--policy", "idm", "--duration", "8")
    assert [key for key in REQUIRED.split() if key not in found] == []
    assert found["steps"] == 20
    assert found["preset"] == "lawful"
    assert found["units"]["dt_mean_m"] == "m"
    assert 8 * 5 < found["dt_mean_m"] < 8 * 30
    assert found["timings"]["decision_s"] < found["timings"]["simulation_s"]


def test_the_same_seed_in_fresh_processes_is_the_same_run_and_another_seed_is_not() -> None:
    same = [
        document("merge", "--policy", "altruist-rule", "--duration", "10", "--seed", "200003") for _ in "ab"
    ]
    other = document("merge", "--policy", "altruist-rule", "--duration", "10", "--seed", "200004")
    assert same[0]["trace_hash"] == same[1]["trace_hash"]
    assert other["trace_hash"] != same[0]["trace_hash"]
    timeless = [{k: v for k, v in d.items() if k != "timings"} for d in same]
    assert timeless[0] == timeless[1]


def test_drivers_err_where_errors_are_asked_for() -> None:
    asked = ["merge", "--demand", "contested", "--policy", "idm", "--duration", "12", "--seed", "200003"]
    plain, erring = (document(*asked, *more) for more in ((), ("--errors", "stress")))
    assert plain["human_errors"] == 0
    assert erring["human_errors"] > 5
    assert erring["errors"] == "stress"
    assert erring["trace_hash"] != plain["trace_hash"]


def test_the_whole_agent_commands_every_av_and_says_what_is_untrained() -> None:
    found = document("merge", "--policy", "vfn-p", "--duration", "4", "--seed", "200001")
    assert found["policy_label"] == make("vfn-p").label
    assert found["veto_rate"] is not None
    assert found["timings"]["decision_s"] > 0


def test_a_users_scenario_runs_unmodified(a10kw: str) -> None:
    found = document(
        a10kw, "--penetration", "0.2", "--policy", "idm", "--duration", "200", "--seed", "200000"
    )
    assert found["scenario"] == "game/A10KW"
    assert found["behavior"] == "as-is"
    assert found["vehicles_inserted"] > 400
    assert found["hv_hv_collisions"] == 0
    assert found["mission_success"] is not None, "the mission vehicle is found from the net"
    waiting, inserted = found["vehicles_never_inserted"], found["vehicles_inserted"]
    said = any("no room" in reason for reason in found["not_comparable_because"])
    assert said == (waiting > 0.05 * (waiting + inserted))


def test_a_users_scenario_with_table_ii_drivers(a10kw: str) -> None:
    found = document(
        a10kw, "--penetration", "0.2", "--policy", "idm", "--duration", "200", "--behavior", "mixed"
    )
    assert found["vehicles_inserted"] > 400
    assert found["hv_hv_collisions"] == 0


def test_the_whole_agent_drives_on_a_users_scenario(a10kw: str) -> None:
    found = document(a10kw, "--penetration", "0.2", "--policy", "vfn-p", "--duration", "12")
    assert found["policy_label"] == make("vfn-p").label
    assert found["steps"] > 1


def test_the_run_folder_holds_result_manifest_and_table(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "run"
    run("merge", "--duration", "2", "--out", str(out))
    result = json.loads((out / "result.json").read_text())
    manifest = json.loads((out / "manifest.json").read_text())
    assert result["manifest"] == manifest
    assert manifest["seed"] == 200000
    assert manifest["versions"]["libsumo"] == "1.28.0"
    assert "merge.sumocfg" in manifest["files"]
    assert sorted(p.name for p in out.iterdir()) == ["manifest.json", "metrics.txt", "result.json"]


def test_another_policy_drives_the_same_traffic_beside_it(tmp_path: Path) -> None:
    contested = ["merge", "--demand", "contested", "--duration", "8", "--policy", "altruist-rule"]
    out = tmp_path / "run"
    done = run(*contested, "--beside", "idm", "--out", str(out))
    alone = {policy: document(*contested[:-1], policy)["trace_hash"] for policy in ("altruist-rule", "idm")}
    assert all(f"trace hash {policy}: {trace}" in done.stdout for policy, trace in alone.items())
    assert "mission.0 is the mission vehicle: the human driver that has to merge." in done.stdout
    assert f"cosim replay {out} --beside idm" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 100 + len(str(out))
    assert json.loads((out / "result.json").read_text())["policy"] == "altruist-rule"


@pytest.mark.parametrize(
    ("beside", "said"),
    [
        (["imd"], "--beside='imd': unknown policy, did you mean 'idm'?"),
        (["altruist-rule"], "--beside='altruist-rule': is the policy that drives already"),
        (["idm", "--json"], "--beside='idm': does not go together with --json"),
    ],
)
def test_what_cannot_drive_beside_is_refused(beside: list[str], said: str) -> None:
    done = run("merge", "--policy", "altruist-rule", "--beside", *beside, expect=2)
    assert said in done.stderr


def test_sumo_s_own_options_pass_after_the_dashes() -> None:
    slow = document("merge", "--duration", "4", "--", "--scale", "0.2")
    assert slow["manifest"]["sumo_options"]["scale"] == "0.2"
    assert slow["vehicles_inserted"] < document("merge", "--duration", "4")["vehicles_inserted"]


def test_the_scenarios_are_listed_for_machines() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cosim.cli.main", "scenarios", "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    worlds = {row["name"]: row for row in json.loads(done.stdout)}
    assert tuple(worlds) == (*sumo_scenarios.names(), *sumo_scenarios.open_roads())
    assert all(
        {"free", "dense", "contested"} <= set(worlds[name]["demands"]) for name in sumo_scenarios.names()
    )
