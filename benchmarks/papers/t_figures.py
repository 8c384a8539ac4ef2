"""T's figures 5, 6, 7: how far the merging vehicle comes; crashes, distance, merges; all that over training.

    python -m benchmarks.papers.t_figures [--scale 1] [--training conv3d-a2c=runs/a2c] [--dry-run]

Egoistic against altruistic as T has it, each trained apart; beside them the scripted altruist, SUMO's own
IDM and the approach that learns as T's does. Figure 8 is `benchmarks.papers.t_figure8`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks import learning_curves
from benchmarks.arms import differences
from benchmarks.papers.agents import Agent
from benchmarks.papers.claims import MERGING_ALTRUISTIC, MERGING_EGOISTIC, VFN_P
from benchmarks.papers.driving import SVO, Order, Results, Settings
from benchmarks.papers.pages import Job, drawing, heading, save, save_picture
from benchmarks.tables import Line, difference_lines, difference_table, lines_of, markdown_row, table
from benchmarks.targets import headline
from cosim.report.run_folder import Run
from cosim.report.statistics import quantile, share
from cosim.types import Floats
from cosim.workers.tasks import OK

ALTRUIST, EGOIST = VFN_P, "vfn-p-egoistic"
EPISODES = 300  # T: 3,000 test episodes
ARMS = ((EGOIST, 0.0), (ALTRUIST, SVO), ("conv3d-a2c", SVO), ("idm", SVO), ("altruist-rule", SVO))
TRAFFIC = (("contested", "moderate"), ("dense", "mixed"))
WORLD = "merge"
FIGURES = ("collision_rate", "mission_success_rate", "dt_mean_m", "dt_av_m", "dt_hv_m", "dt_mission_m")


def orders() -> list[Order]:
    """Egoists, altruists and their yardsticks at the ramp, in contested and in dense traffic."""
    return [
        Order(Agent(policy), WORLD, demand, behavior, EPISODES, svo)
        for demand, behavior in TRAFFIC
        for policy, svo in ARMS
    ]


def write(results: Results, settings: Settings) -> None:
    """t_figures.md, t_figure5.svg, t_figure6.svg, t_figure7.png, data/t_figures.csv."""
    page = heading(
        JOB, results, settings, f"World `{WORLD}`; `vfn-p-egoistic` with phi 0, the others with 45 degrees."
    )
    lines: list[Line] = []
    names = {one.order.name: one.name for one in results.driven if one.rows}
    runs = {demand: results.runs(demand=demand) for demand, _ in TRAFFIC}
    if runs["contested"]:
        page += ["## Figure 5: how far the merging vehicle comes", "", _distances(runs, settings), ""]
        page += [
            f"T: about {MERGING_EGOISTIC:g} m among egoists, {MERGING_ALTRUISTIC:g} m among altruists.",
            "",
        ]
        page += _quantiles(runs)
        page += ["## Figure 6: crashes, distance, merges", "", _bars(runs, settings), ""]
    for demand, behavior in TRAFFIC:
        if not runs[demand]:
            continue
        page += [f"### {demand}, {behavior} drivers", "", *table(WORLD, runs[demand], FIGURES)]
        lines += lines_of(f"{demand}, {behavior}", [WORLD], runs[demand], FIGURES)
        before, after = names.get(EGOIST, ""), names.get(ALTRUIST, "")
        if {before, after} <= runs[demand].keys():
            pair = differences(runs[demand][before], runs[demand][after])
            page += ["T's claims on equal seeds, altruists less egoists:", ""]
            page += [f"- {claim}: {headline(pair[WORLD].figures[figure])}" for figure, claim in CLAIMS]
            page += ["", *difference_table({f"{after} less {before}": pair[WORLD]}, FIGURES)]
            lines += difference_lines(f"{demand}, {behavior}", after, before, pair, FIGURES)
    page += ["## Figure 7: the course of training", "", *_courses(settings)]
    save(JOB, settings, page, lines)


CLAIMS = (
    ("collision_rate", "altruists crash less"),
    ("dt_mean_m", "the distance of all vehicles is higher"),
    ("mission_success_rate", "more merging vehicles merge"),
    ("dt_mission_m", "the merging vehicle comes further"),
)


def _courses(settings: Settings) -> list[str]:
    """The picture of figure 7, and which trainings are not there."""
    runs, page = [], []
    for policy in (EGOIST, ALTRUIST, "conv3d-a2c"):
        folders = settings.trained(policy)
        runs += [learning_curves.read(f"{policy}={folder}") for folder in folders]
        if not folders:
            page.append(f"- {policy}: not run yet (`{Agent(policy).command}`, or `--training {policy}=RUN`)")
    page += [""] if page else []
    if runs:
        settings.out.mkdir(parents=True, exist_ok=True)
        learning_curves.draw(settings.out / "t_figure7.png", runs)
        page += ["![t_figure7](t_figure7.png)", ""]
        note = f"Training drives explore: means over {learning_curves.WINDOW} iterations."
        page += [f"{note} Validation is greedy, on", "tuning seeds. Thin: a run each; thick: their mean.", ""]
    return page


def _driven(run: Run) -> Floats:
    """How far the merging vehicle came in each episode, m."""
    found = [row.get("dt_mission_m") for row in run.rows if row["status"] == OK]
    return np.array([v for v in found if v is not None], np.float64)


def _distances(runs: Mapping[str, Mapping[str, Run]], settings: Settings) -> str:
    """Figure 5: a histogram per arm, egoists grey and altruists orange as in T."""
    demands = [d for d in runs if runs[d]]
    picture = drawing(5.0 * len(demands), 3.4)
    for axes, demand in zip(picture.subplots(1, len(demands), squeeze=False)[0], demands, strict=True):
        every = np.concatenate([_driven(run) for run in runs[demand].values()])
        bins = np.linspace(0.0, max(float(every.max(initial=1.0)), 1.0), 41)
        for k, (name, run) in enumerate(runs[demand].items()):
            values = _driven(run)
            if not len(values):
                continue
            heights = np.full(len(values), 100.0 / len(values))
            main = name.split(" (")[0] in (EGOIST, ALTRUIST)
            colour = {EGOIST: "0.45", ALTRUIST: "tab:orange"}.get(name.split(" (")[0], f"C{k}")
            axes.hist(
                values, bins, weights=heights, histtype="stepfilled" if main else "step",
                alpha=0.6 if main else 1.0, color=colour, label=name,
            )  # fmt: skip
        axes.set(title=demand, xlabel="distance of the merging vehicle, m", ylabel="% of episodes")
        axes.legend(fontsize="small")
    return save_picture(picture, settings.out / "t_figure5.svg")


def _quantiles(runs: Mapping[str, Mapping[str, Run]]) -> list[str]:
    """Quartiles of the distance, and how often it stays nearer to T's egoists than to T's altruists."""
    middle = 0.5 * (MERGING_EGOISTIC + MERGING_ALTRUISTIC)
    heads = [
        "demand",
        "arm",
        "lower quartile, m",
        "median, m",
        "upper quartile, m",
        f"below {middle:g} m, %",
        "n",
    ]
    page = [markdown_row(heads), "|---" * len(heads) + "|"]
    for demand, arms in runs.items():
        for name, run in arms.items():
            values = _driven(run)
            cells: Sequence[str] = [quantile(values, q).text(0) for q in (0.25, 0.5, 0.75)]
            short = share(int((values < middle).sum()), len(values)).text(1, 100.0)
            page.append(markdown_row([demand, name, *cells, short, str(len(values))]))
    return [*page, ""]


def _bars(runs: Mapping[str, Mapping[str, Run]], settings: Settings) -> str:
    """Figure 6: three panels, a point with its interval per arm and demand."""
    panels = (("collision_rate", "episodes with a crash, %", 100.0), ("dt_mean_m", "distance of all, m", 1.0),
              ("mission_success_rate", "episodes with a merge, %", 100.0))  # fmt: skip
    picture = drawing(10.0, 3.2)
    arms = list(dict.fromkeys(name for of_demand in runs.values() for name in of_demand))
    for axes, (figure, title, scale) in zip(picture.subplots(1, len(panels)), panels, strict=True):
        for k, (demand, of_demand) in enumerate(runs.items()):
            for line in lines_of(demand, [WORLD], of_demand, [figure]):
                if math.isnan(line.value):
                    continue
                ends = np.nan_to_num([[line.value - line.low], [line.high - line.value]]).clip(0.0)
                place = arms.index(line.arm) + 0.15 * (2 * k - 1)
                axes.errorbar(
                    place, scale * line.value, scale * ends, fmt="so"[k], ms=4, capsize=2, color=f"C{k}"
                )
            axes.plot([], [], "so"[k], color=f"C{k}", label=demand)
        axes.set_xticks(range(len(arms)), arms, rotation=30, ha="right")
        axes.set(title=title)
        axes.grid(axis="y", alpha=0.3)
    picture.axes[0].legend(fontsize="small")
    return save_picture(picture, settings.out / "t_figure6.svg")


JOB = Job("t_figures", "Figures 5 to 7 of T: the merging vehicle among egoists and altruists", orders, write)

if __name__ == "__main__":
    JOB.main()
