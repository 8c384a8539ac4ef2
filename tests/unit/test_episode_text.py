"""What `cosim run` says of an episode: who the mission vehicle is, what became of it, what idm does there."""

from __future__ import annotations

from typing import Any

import pytest

from cosim.report.episode_text import COLUMNS, text
from cosim.types import Collision, EpisodeResult, Metric

UNITS = {
    "mission_time_s": "s",
    "dt_mean_m": "m",
    "dt_av_m": "m",
    "dt_hv_m": "m",
    "vehicles_inserted": "vehicles",
}


def driven(policy: str, *, collisions: tuple[Collision, ...] = (), **values: Any) -> EpisodeResult:
    """Forty seconds of a contested merge."""
    figures: dict[str, Any] = {
        "mission_success": True,
        "mission_time_s": 23.2,
        "dt_mean_m": 655.0,
        "dt_av_m": 623.0,
        "dt_hv_m": 661.0,
        "collisions": len(collisions),
        "min_ttc_s": None,
        "teleports": 0,
        "interventions": 0,
        "vehicles_inserted": 61,
    } | values
    return EpisodeResult(
        scenario="merge",
        demand="contested",
        policy=policy,
        policy_label="",
        behavior="moderate",
        driver_model="lc2013",
        penetration=None,
        preset="lawful",
        svo_deg=45.0,
        seed=200_000,
        steps=100,
        trace_hash="ab" * 32,
        metrics={name: Metric(value, UNITS.get(name, ""), "") for name, value in figures.items()},
        collisions=collisions,
        timings={"reset_s": 0.2, "decision_s": 4.8, "compilation_s": 19.6, "total_s": 26.0},
        validity=(),
        mission_vehicle="mission.0",
        manifest={
            "timing": {"decision_s": 0.4, "begin_s": 0.0, "warmup_s": 40.0},
            "options_not_passed_on": [],
        },
    )


def crash() -> Collision:
    return Collision(
        time=52.0,
        collider="av.1",
        victim="hv.2",
        lane="main_0",
        collider_is_av=True,
        victim_is_av=False,
        av_caused=True,
        kind="collision",
        source="sumo",
        x=0.0,
        y=0.0,
    )


def rows(said: str) -> dict[str, list[str]]:
    """The table's cells by the name of the figure."""
    found = (line.rsplit(maxsplit=1) for line in said.splitlines() if line.startswith("  "))
    return {name: cells.split() for cells, name in found if "_" in name}


def test_it_says_who_the_mission_vehicle_is_and_what_became_of_it() -> None:
    said = text(driven("vfn-p"), mission="merge")
    assert "mission.0 is the mission vehicle: the human driver that has to merge." in said
    assert "It merged after 23.2 s." in said
    assert "no collision" in said
    several = text(driven("idm", mission_success=False, mission_time_s=None), mission="roundabout")
    assert "It did not enter the roundabout within 40 s." in several


def test_two_policies_in_the_same_traffic_stand_side_by_side() -> None:
    beside = driven("idm", mission_success=False, mission_time_s=None, dt_mean_m=682.0, dt_av_m=680.0)
    said = text(driven("vfn-p"), beside, mission="merge")
    assert "With vfn-p it merged after 23.2 s." in said
    assert "With idm it did not merge within 40 s." in said
    assert "all vehicles 27 m less, AVs 57 m less" in said
    assert rows(said)["mission_success"][-2:] == ["yes", "no"]
    assert rows(said)["dt_av_m"][-3:] == ["623", "680", "-57"]


def test_what_happened_to_nobody_has_no_row() -> None:
    said = text(driven("vfn-p", interventions=29))
    assert "teleports" not in rows(said), "named below the table"
    assert "none or 0: teleports" in said
    assert "min_ttc_s" not in said, "NA says nothing"
    assert "interventions" in said


def test_a_collision_is_told_with_its_time_and_its_place() -> None:
    said = text(driven("vfn-p", collisions=(crash(),)), driven("idm"))
    assert "vfn-p: collision at 12.0 s (SUMO's clock: 52.0 s): av.1 hit hv.2 on main_0" in said
    assert "idm: no collision" in said


def test_the_compilation_is_named_and_timed_apart() -> None:
    assert "time: 26.0 s, of it compiling kernels 19.6 s (first use only)" in text(driven("vfn-p"))


@pytest.mark.parametrize("every", [False, True])
def test_no_line_is_too_long(every: bool) -> None:
    said = text(driven("vfn-p", collisions=(crash(),)), driven("altruist-rule"), mission="merge", every=every)
    assert max(map(len, said.splitlines())) <= COLUMNS


def test_rounding_is_nothing_and_a_distance_of_nothing_is_shown() -> None:
    result = driven("idm", worst_speeding_mps=7.1e-15, min_ttc_s=0.0, uncounted_overlaps=1)
    result.metrics["min_ttc_s"] = Metric(0.0, "s", "higher")
    lines = text(result).splitlines()
    assert not [line for line in lines if "worst_speeding" in line or "e-15" in line]
    assert [line.split()[-2:] for line in lines if "min_ttc_s" in line] == [["0", "min_ttc_s"]]
    assert [line.split()[-2:] for line in lines if "uncounted" in line] == [["1", "uncounted_overlaps"]]
