"""Who is served when somebody yields: the scripted policies on every world's contested demand, equal seeds.

    python -m benchmarks.altruism [--scale 1] [--scenario merge] [--out DIR]

Writes altruism.md and data/altruism.csv into --out (docs/results), from episodes of the store that all result
pages share; the distance ratio is of means over equal seeds.
"""

from __future__ import annotations

from benchmarks.arms import differences, of_world
from benchmarks.papers.agents import Agent
from benchmarks.papers.driving import Order, Results, Settings
from benchmarks.papers.pages import Job, heading, save
from benchmarks.tables import lines_of, table
from benchmarks.targets import farther
from benchmarks.worlds import WORLDS

POLICIES = ("idm", "idm-courteous", "altruist-rule", "keep-lane")
EPISODES = 40  # a world
COLUMNS = (
    "mission_success_rate",
    "collision_rate",
    "av_caused_collision_rate",
    "dt_mission_m",
    "dt_av_m",
    "dt_mean_m",
    "hard_brakings_av",
)


def orders() -> list[Order]:
    """Moderate drivers, as the demand has them."""
    return [
        Order(Agent(policy), world, "contested", "moderate", EPISODES)
        for world in WORLDS
        for policy in POLICIES
    ]


def write(results: Results, settings: Settings) -> None:
    """altruism.md, data/altruism.csv."""
    runs = results.runs()
    worlds = [w for w in WORLDS if any(of_world(run, w) for run in runs.values())]
    page = heading(JOB, results, settings)
    for world in worlds:
        served = runs["idm"].measures["mission_success_rate"].values(of_world(runs["idm"], world))
        has_mission = any(value == value for value in served)  # nan: NA
        about = "Drivers moderate."
        page += [f"## {world}, contested", ""]
        page += [
            about if has_mission else f"{about} Nobody has a mission here, so nothing is claimed about one.",
            "",
        ]
        page += table(world, runs, COLUMNS)
        if has_mission:
            ratio = farther(differences(runs["idm"], runs["altruist-rule"])[world])
            page += [
                f"The mission vehicle travels {ratio.text(2)} times as far with `altruist-rule`.",
                "",
            ]
    save(JOB, settings, page, lines_of("contested", worlds, runs, COLUMNS))


JOB = Job("altruism", "Who is served when somebody yields", orders, write, "benchmarks")

if __name__ == "__main__":
    JOB.main()
