"""P's figure 9: trained and tested among conservative, aggressive and mixed drivers.

    python -m benchmarks.papers.figure9 [--scale 1] [--dry-run]

Six networks were trained for it at commit f591cb8, with and without prediction; what is missing is said.
"""

from __future__ import annotations

from benchmarks.arms import differences
from benchmarks.papers.agents import Agent
from benchmarks.papers.claims import VFN, VFN_P
from benchmarks.papers.driving import Order, Results, Settings
from benchmarks.papers.pages import Job, heading, save
from benchmarks.tables import (
    Line,
    difference_lines,
    difference_table,
    found,
    lines_of,
    markdown_row,
    picture,
    table,
)
from cosim.report.figures import RATES, Measure
from cosim.report.run_folder import Run
from cosim.report.statistics import Figure

BEHAVIORS = ("conservative", "aggressive", "mixed")
APPROACHES = (VFN, VFN_P)  # without and with prediction
SAME, CROSSED = 300, 100  # episodes where test is as training, and where it is not
WORLD, DEMAND = "merge", "dense"
FIGURES = ("collision_rate", "av_caused_collision_rate", "dt_mean_m", "mission_success_rate", "veto_rate")
COMPARED = ("collision_rate", "dt_mean_m", "mission_success_rate")
DISTANCE = Measure("dt_mean_m", "dt_mean_m", "m", "higher")
FOLDER = "runs/figure9"


def agent(approach: str, behavior: str) -> Agent:
    """An approach that was trained among one kind of drivers."""
    weights = f"{FOLDER}/{approach}-{behavior}/best.safetensors"
    return Agent(f"{approach}, {behavior}", approach, weights, made_by=command(approach, behavior))


def command(approach: str, behavior: str) -> str:
    """What trains it; the same again with --resume goes on."""
    out = f"{FOLDER}/{approach}-{behavior}"
    return f"cosim train vfn --policy {approach} --config {FOLDER}/{behavior}.yaml --workers 2 --out {out}"


def training() -> list[str]:
    """All commands, in order."""
    return [command(a, b) for b in BEHAVIORS for a in APPROACHES]


def orders() -> list[Order]:
    """Every network among every kind of drivers; most where these are those it was trained among."""
    return [
        Order(agent(approach, trained), WORLD, DEMAND, tested, SAME if tested == trained else CROSSED)
        for tested in BEHAVIORS
        for trained in BEHAVIORS
        for approach in APPROACHES
    ]


def write(results: Results, settings: Settings) -> None:
    """figure9.md, figure9.png, data/figure9.csv."""
    page = heading(JOB, results, settings, f"World `{WORLD}`, demand `{DEMAND}`, phi 45 degrees.")
    page += [
        "Six networks, each trained by one command at commit f591cb8 (how long stands above).",
        "",
        "```",
    ]
    page += [*training(), "```", ""]
    lines: list[Line] = []
    names = {one.order.name: one.name for one in results.driven if one.rows}
    if names:
        panels: dict[str, dict[str, dict[str, Figure]]] = {
            "crashes, test as training": {},
            "distance of all vehicles": {},
        }
        for approach in APPROACHES:
            for title, measure in zip(panels, (RATES["collision_rate"], DISTANCE), strict=True):
                panels[title][approach] = {
                    b: found(_of(results, b, names[agent(approach, b).name]).rows, measure)[0]
                    for b in BEHAVIORS
                    if agent(approach, b).name in names
                }
        settings.out.mkdir(parents=True, exist_ok=True)
        picture(settings.out / "figure9.png", panels, ["crashes, test as training"])
        page += ["![figure 9](figure9.png)", ""]
    for tested in BEHAVIORS:
        runs = results.runs(behavior=tested)
        if not runs:
            continue
        page += [f"## Tested among {tested} drivers", "", *table(WORLD, runs, FIGURES)]
        lines += lines_of(f"{DEMAND}, {tested}", [WORLD], runs, FIGURES)
        for trained in BEHAVIORS:
            without, with_ = (names.get(agent(a, trained).name, "") for a in APPROACHES)
            if without in runs and with_ in runs:
                pair = differences(runs[without], runs[with_])
                page += [f"Trained among {trained} drivers: what prediction changes, paired:", ""]
                page += difference_table({"with less without prediction": pair[WORLD]}, COMPARED)
                lines += difference_lines(f"{DEMAND}, {tested}", with_, without, pair, COMPARED)
    page += _trained(names)
    save(JOB, settings, page, lines)


def _of(results: Results, behavior: str, name: str) -> Run:
    return results.runs(behavior=behavior)[name]


def _trained(names: dict[str, str]) -> list[str]:
    """Which of the six networks there are."""
    page = ["## The networks", "", markdown_row(["", *BEHAVIORS]), "|---" * (len(BEHAVIORS) + 1) + "|"]
    for approach in APPROACHES:
        cells = [names.get(agent(approach, b).name, "not trained yet") for b in BEHAVIORS]
        page.append(markdown_row([approach, *cells]))
    return [*page, ""]


JOB = Job("figure9", "Figure 9 of P: what prediction gains among three kinds of drivers", orders, write)

if __name__ == "__main__":
    JOB.main()
