"""What perception range, V2V and the human drivers change: AVs perceive and share less, HVs cooperate less.

    python -m benchmarks.papers.conditions [--scale 1] [--scenario merge] [--dry-run]

The network was trained with all its senses; nothing is trained again for a table of this page.
T's worst case: every HV an egoist (Table II's aggressive drivers, politeness 0).
"""

from __future__ import annotations

from benchmarks.arms import differences, of_world
from benchmarks.papers.agents import PERCEPTION, Agent
from benchmarks.papers.claims import VFN_P
from benchmarks.papers.driving import Order, Results, Settings
from benchmarks.papers.pages import Job, heading, save
from benchmarks.tables import (
    Line,
    difference_lines,
    difference_table,
    found,
    lines_of,
    picture,
    table,
)
from cosim.report.figures import RATES, Measure

AGENT = VFN_P
RANGES = (25.0, 50.0, 75.0, PERCEPTION)  # m
SENSED = (("merge", "contested", "moderate"), ("intersection", "dense", "mixed"))
DRIVEN_BY = ("conservative", "moderate", "aggressive")  # HVs, in the contested merge
YARDSTICKS = (("vfn-p-egoistic", 0.0), ("idm", 45.0), ("altruist-rule", 45.0))
EPISODES = 100
FIGURES = ("collision_rate", "mission_success_rate", "dt_mean_m", "dt_mission_m", "veto_rate")
COMPARED = ("collision_rate", "mission_success_rate", "dt_mean_m", "dt_mission_m")
CRASHES = "crashes"
SHOWN = {
    CRASHES: RATES["collision_rate"],
    "mission vehicle": Measure("dt_mission_m", "dt_mission_m", "m", "higher"),
}


def sensing() -> list[Agent]:
    """Range x shared perception, and intentions withheld; the first one has it all."""
    whole = Agent(AGENT)
    alone = [Agent(f"{r:g} m, alone", AGENT, perception_range=r, share_perception=False) for r in RANGES]
    shared = [Agent(f"{r:g} m, shared", AGENT, perception_range=r) for r in RANGES[:-1]]
    no_intentions = Agent("no intentions", AGENT, share_intentions=False)
    no_v2v = Agent("no V2V at all", AGENT, share_perception=False, share_intentions=False)
    return [whole, *shared, *alone, no_intentions, no_v2v]


def orders() -> list[Order]:
    """Senses in two worlds; human drivers of each kind in the contested merge."""
    found_ = [Order(a, *traffic, EPISODES) for traffic in SENSED for a in sensing()]
    for behavior in DRIVEN_BY:
        for name, phi in ((AGENT, 45.0), *YARDSTICKS):
            found_.append(Order(Agent(name), "merge", "contested", behavior, EPISODES, phi))
    return found_


def write(results: Results, settings: Settings) -> None:
    """conditions.md, conditions.png, data/conditions.csv."""
    past = "Whoever is perceived has its whole past in the kinematic rows (observation.md)."
    page = heading(JOB, results, settings, "phi 45 degrees, the egoistic twin's 0.", past)
    senses = {agent.name for agent in sensing()}
    lines: list[Line] = []
    panels = {}
    whole = next((one.name for one in results.driven if one.rows and one.order.name == AGENT), "")
    for world, demand, behavior in SENSED:
        here = {one.name for one in results.driven if one.order.name in senses}
        runs = {
            name: run
            for name, run in results.runs(demand=demand, behavior=behavior).items()
            if name in here and of_world(run, world)
        }
        if not runs:
            continue
        traffic = f"{demand}, {behavior}"
        page += [f"## Senses: {world}, {traffic}", "", *_legend(), *table(world, runs, FIGURES)]
        lines += lines_of(traffic, [world], runs, FIGURES)
        for title, measure in SHOWN.items():
            panels[f"{title}: {world}, {demand}"] = {
                name: {world: found(of_world(run, world), measure)[0]} for name, run in runs.items()
            }
        pairs = {
            name: {world: differences(runs[whole], run)[world]}
            for name, run in runs.items()
            if whole in runs and name != whole
        }
        for name, pair in pairs.items():
            lines += difference_lines(traffic, name, whole, pair, COMPARED)
        if pairs:
            page += [f"Less `{whole}`, which has it all, paired:", ""]
            page += difference_table({name: pair[world] for name, pair in pairs.items()}, COMPARED)
    if panels:
        settings.out.mkdir(parents=True, exist_ok=True)
        shares = [title for title in panels if title.startswith(CRASHES)]
        picture(settings.out / "conditions.png", panels, shares)
        page += ["![crashes, distance of the mission vehicle](conditions.png)", ""]
    for behavior in DRIVEN_BY:
        wanted = {AGENT, *(name for name, _ in YARDSTICKS)}
        here = {one.name for one in results.driven if one.order.name in wanted}
        runs = results.runs(demand="contested", behavior=behavior)
        runs = {name: run for name, run in runs.items() if name in here and of_world(run, "merge")}
        if runs:
            worst = ": T's worst case" if behavior == "aggressive" else ""
            page += [f"## Human drivers all {behavior}{worst}: merge, contested", ""]
            page += table("merge", runs, FIGURES)
            lines += lines_of(f"contested, {behavior}", ["merge"], runs, FIGURES)
    save(JOB, settings, page, lines)


def _legend() -> list[str]:
    return [
        "`shared`: AVs also know what their allies perceive; `alone`: they do not. Intentions are what each",
        "AV tells those behind it that it will do.",
        "",
    ]


JOB = Job("conditions", "What perception range, V2V and the human drivers change", orders, write)

if __name__ == "__main__":
    JOB.main()
