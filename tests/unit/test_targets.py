"""The decision layer's targets: held against figures with their intervals, said in words, missed ones too."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import run_rows

from benchmarks import altruism, targets
from benchmarks.arms import differences
from benchmarks.papers import decisions
from benchmarks.papers.agents import Agent
from benchmarks.papers.claims import VFN_P
from benchmarks.papers.driving import Driven, Order, Results, Settings
from benchmarks.tables import difference_table, table
from benchmarks.targets import Arms
from cosim.report.run_folder import Run
from cosim.report.statistics import Figure

NOTES = {"units": run_rows.UNITS, "better": run_rows.BETTER}
PARTS = Arms(VFN_P, "vfn-p-egoistic")
EPISODES = 100


def rows(
    policy: str, world: str, demand: str = "contested", **columns: Sequence[Any]
) -> list[dict[str, Any]]:
    """100 episodes of one policy in one world; `columns`: by name, a value per episode."""
    svo = decisions.svo(policy)
    found = run_rows.cell(policy, EPISODES, columns=columns, what=world, demand=(demand,), svo_deg=svo)
    return [row for _, row in found]


def first(hits: int) -> list[bool]:
    """True in the first so many episodes."""
    return [k < hits for k in range(EPISODES)]


def run(*parts: list[dict[str, Any]]) -> Run:
    every = [row for part in parts for row in part]
    return Run(Path(str(every[0]["policy"])), every, NOTES)


def contested(world: str, **success: int) -> dict[str, Run]:
    """Runs in which so many missions were fulfilled; AVs give up distance as they yield."""
    found = {}
    for name, hits in success.items():
        policy = {"twin": "vfn-p-egoistic", "rule": "altruist-rule", "agent": VFN_P}.get(name, name)
        served = first(hits)
        found[policy] = run(
            rows(
                policy,
                world,
                mission_success=served,
                dt_mission_m=[600.0 + k % 7 if s else 250.0 + k % 5 for k, s in enumerate(served)],
                dt_av_m=[650.0 - 0.5 * hits + k % 3 for k in range(EPISODES)],
                hard_brakings_av=[9 if policy == "altruist-rule" else 4 + k % 2 for k in range(EPISODES)],
            )
        )
    return found


@pytest.mark.parametrize(
    ("value", "low", "high", "verdict"),
    [
        (0.95, 0.91, 0.98, "met"),
        (0.92, 0.85, 0.96, "met; the interval reaches beyond the target"),
        (0.88, 0.80, 0.93, "**missed**; the interval still holds the target"),
        (0.60, 0.50, 0.70, "**missed**"),
        (0.90, math.nan, math.nan, "met"),
        (math.nan, math.nan, math.nan, "**not measured**"),
    ],
)
def test_a_target_is_met_by_its_value_and_the_interval_says_how_surely(
    value: float, low: float, high: float, verdict: str
) -> None:
    assert targets.judged(Figure(value, low, high), "at least", 0.9) == verdict
    mirrored = Figure(-value, -high, -low)
    assert targets.judged(mirrored, "at most", -0.9) == verdict


def test_three_crashes_in_three_hundred_are_at_most_one_per_cent() -> None:
    assert targets.judged(Figure(3 / 300, 0.0034, 0.029), "at most", 0.01).startswith("met")
    assert targets.judged(Figure(4 / 300, 0.0052, 0.034), "at most", 0.01).startswith("**missed**")


def test_an_agent_that_yields_as_asked_meets_every_target_at_the_ramp() -> None:
    runs = contested("merge", agent=97, twin=20, idm=4, rule=95)
    found = list(targets.contested(runs, ["merge"], PARTS))
    assert len(found) == 7
    verdicts = {f.target: f.verdict for f in found}
    assert verdicts["lets at least 90 % in"] == "met"
    assert verdicts["`idm` at most 10 %"] == "met"
    assert verdicts["the egoistic twin at least 40 points less"] == "met"
    assert verdicts["with fewer hard brakings"] == "met"
    assert verdicts["serves at least as many as `altruist-rule`"].startswith("met; the interval")
    # it serves two more than the rule and gives up 1 m for that: a larger loss, and said so
    assert verdicts["and no larger loss of distance for the AVs"] == "**missed**"
    assert [f.target for f in found if not f.met] == ["and no larger loss of distance for the AVs"]
    ratio = next(f for f in found if "times as far" in f.target)
    assert ratio.met
    assert float(ratio.found.split()[0]) == pytest.approx(
        (97 * 603 + 3 * 252) / (4 * 603 + 96 * 252), abs=0.03
    )


def test_a_twin_that_lets_the_car_in_as_well_leaves_altruism_nothing_to_show() -> None:
    runs = contested("merge", agent=97, twin=80, idm=40, rule=95)
    missed = {f.target: f.verdict for f in targets.contested(runs, ["merge"], PARTS) if not f.met}
    assert missed["the egoistic twin at least 40 points less"] == "**missed**"
    assert missed["`idm` at most 10 %"] == "**missed**"


@pytest.mark.parametrize(
    ("twin", "verdict"),
    [(40, "met"), (57, "**missed**: not beyond chance"), (60, "**missed**"), (70, "**missed**")],
)
def test_above_the_twin_needs_more_than_chance(twin: int, verdict: str) -> None:
    """3 of 100 gained and none lost: Tango's interval leaves 0 out, the exact test (p 0.25) does not."""
    runs = contested("exit", agent=60, twin=twin, idm=10, rule=50)
    found = {f.target: f for f in targets.contested(runs, ["exit", "highway"], PARTS)}
    assert found["significantly above the twin"].verdict == verdict
    assert found["at least 40 points above `idm`"].verdict == "met"
    assert f"{60 - twin:+.1f} pp".replace("+0.0", "0.0") in found["significantly above the twin"].found


def test_crashes_and_lost_distance_are_judged_in_every_world() -> None:
    worlds = ["merge", "roundabout"]
    agent = [rows(VFN_P, w, "dense", crashed=first(2), dt_mean_m=[790.0] * EPISODES) for w in worlds]
    idm = [rows("idm", w, "dense", dt_mean_m=[800.0 + k % 2 for k in range(EPISODES)]) for w in worlds]
    runs = {VFN_P: run(*agent), "idm": run(*idm)}
    verdicts = {(f.world, f.target): f.verdict for f in targets.dense(runs, worlds, PARTS)}
    assert verdicts["merge", "crashes in at most 1 %"].startswith("**missed**; the interval")
    assert verdicts["roundabout", "crashes in at most 3 %"].startswith("met; the interval")
    assert verdicts["merge", "DT of all vehicles no lower than idm's"] == "**missed**"


def test_the_headline_is_given_either_way() -> None:
    twin = run(
        rows("vfn-p-egoistic", "merge", crashed=first(30), dt_mean_m=[700.0 + k % 3 for k in range(100)])
    )
    agent = run(rows(VFN_P, "merge", crashed=first(2), dt_mean_m=[690.0 + k % 3 for k in range(100)]))
    verdicts = {f.target: f.verdict for f in targets.altruists_against_twin("dense", twin, agent, ["merge"])}
    assert verdicts == {
        "altruists crash less": "shown",
        "the distance of all vehicles is higher": "the other way round",
    }
    verdicts = {
        f.target: f.verdict
        for f in targets.altruists_against_twin("dense", agent, agent_like(agent), ["merge"])
    }
    assert set(verdicts.values()) == {"not shown"}


def agent_like(one: Run) -> Run:
    """Another run of the same figures."""
    return replace(one, path=Path("again"))


def test_tables_leave_out_what_applies_to_nobody_and_count_what_failed() -> None:
    broken = rows("idm", "merge")
    broken[0] |= {"status": "sim_crash", "crashed": None}
    runs = {"idm": run(broken), VFN_P: run(rows(VFN_P, "merge", veto_rate=[0.25] * EPISODES))}
    lines = table("merge", runs, ("collision_rate", "veto_rate"))
    assert lines[0] == "|  | C% | vetoed | not comparable |"
    assert lines[2].startswith("| idm | 0.0 % (0.0 to 3.7), 0/99 | - | 0, 1 failed |")
    assert "| 25 % | 0 |" in lines[3]
    assert (
        table("merge", {"idm": runs["idm"]}, ("collision_rate", "veto_rate"))[0]
        == "|  | C% | not comparable |"
    )


def test_differences_can_be_read_down_or_across() -> None:
    runs = contested("merge", agent=97, twin=20, idm=4, rule=95)
    compared = {name: differences(runs[name], runs[VFN_P])["merge"] for name in ("idm", "altruist-rule")}
    across = difference_table(compared, ("mission_success_rate", "dt_av_m", "veto_rate"))
    assert across[0] == "|  | idm | altruist-rule |"
    assert [line.split(" | ")[0] for line in across[2:4]] == ["| mission success", "| DT AVs"]
    down = difference_table(compared, ("mission_success_rate", "dt_av_m", "veto_rate"), arms_down=True)
    assert down[0] == "|  | mission success | DT AVs |"
    assert [line.split(" | ")[0] for line in down[2:4]] == ["| idm", "| altruist-rule"]
    assert across[2].split(" | ")[1] == down[2].split(" | ")[1]
    assert across[2].split(" | ")[1].startswith("+93.0 pp")


def results(runs: dict[str, dict[str, Run]]) -> Results:
    """As `drive` would give them."""
    driven = []
    for demand, arms in runs.items():
        for name, one in arms.items():
            world = str(one.rows[0]["scenario"])
            order = Order(
                Agent(name), world, demand, decisions.BEHAVIOR[demand], EPISODES, decisions.svo(name)
            )
            driven.append(Driven(order, list(one.rows)))
    return Results(tuple(driven), NOTES)


def test_the_page_names_what_is_missed_before_any_table(tmp_path: Path) -> None:
    runs = {"dense": {}, "contested": contested("merge", agent=70, twin=20, idm=4, rule=95)}
    decisions.write(results(runs), Settings(out=tmp_path))
    page = (tmp_path / "decisions.md").read_text()
    missed = page.index("- merge, contested: lets at least 90 % in (70.0 % (60.4 to 78.1), 100 episodes)")
    assert missed < page.index("| contested | merge |")
    assert "## Altruists against egoists" in page
    assert (tmp_path / "decisions.png").stat().st_size > 5_000
    with (tmp_path / "data" / "decisions.csv").open() as file:
        lines = list(csv.DictReader(file))
    own = next(
        x for x in lines if (x["arm"], x["figure"], x["against"]) == (VFN_P, "mission_success_rate", "")
    )
    assert (float(own["value"]), own["n"]) == (0.7, "100")
    pair = next(x for x in lines if (x["against"], x["figure"]) == ("idm", "mission_success_rate"))
    assert float(pair["value"]) == pytest.approx(0.66)
    assert float(pair["p"]) < 1e-6


def test_a_page_without_the_twin_says_that_nothing_can_be_judged(tmp_path: Path) -> None:
    runs = {"contested": {"idm": contested("merge", idm=4)["idm"]}}
    decisions.write(results(runs), Settings(out=tmp_path))
    page = (tmp_path / "decisions.md").read_text()
    assert "not driven yet" in page
    assert "Altruists against egoists" not in page
    assert "| idm | " in page


def test_altruisms_page_claims_nothing_where_nobody_has_a_mission(tmp_path: Path) -> None:
    runs = contested("merge", idm=4, rule=96)
    highway = rows("idm", "highway", mission_success=[None] * EPISODES)
    runs["idm"] = run(runs["idm"].rows, highway)
    runs["altruist-rule"] = run(
        runs["altruist-rule"].rows, [{**r, "policy": "altruist-rule"} for r in highway]
    )
    driven = [
        Driven(
            Order(Agent(name), world, "contested", "moderate", EPISODES),
            [r for r in one.rows if r["scenario"] == world],
        )
        for name, one in runs.items()
        for world in ("merge", "highway")
    ]
    altruism.write(Results(tuple(driven), NOTES), Settings(out=tmp_path))
    merge, highway_page = (tmp_path / "altruism.md").read_text().split("## highway")
    assert "| idm | 4.0 % (1.6 to 9.8), 4/100 |" in merge
    assert "The mission vehicle travels 2.2" in merge
    assert "Nobody has a mission here" in highway_page
    assert "mission success" not in highway_page
