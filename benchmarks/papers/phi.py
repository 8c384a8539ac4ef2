"""phi from 0 to 90 degrees: who pays and who gains when the AVs weigh the others' interest more.

    python -m benchmarks.papers.phi [--scale 1] [--scenario merge] [--dry-run]

One network that gets phi as an input at run time; its egoistic twin, the scripted altruist and SUMO's IDM
beside it. The picture is the Pareto plot: what the AVs drive against what mission vehicle and HVs drive.
"""

from __future__ import annotations

import numpy as np

from benchmarks.arms import differences, of_world
from benchmarks.papers.agents import Agent
from benchmarks.papers.claims import VFN_P
from benchmarks.papers.driving import Driven, Order, Results, Settings
from benchmarks.papers.pages import Job, drawing, heading, save, save_picture
from benchmarks.tables import Line, difference_lines, difference_table, found, lines_of, table
from benchmarks.worlds import WITH_MISSION
from cosim.report.figures import Measure
from cosim.report.run_folder import Run

PHIS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)  # degrees: from egoist to pure altruist
AGENT = VFN_P
YARDSTICKS = (("vfn-p-egoistic", 0.0), ("idm", 45.0), ("altruist-rule", 45.0))
DEMAND, BEHAVIOR = "contested", "moderate"
EPISODES = 100
FIGURES = ("collision_rate", "mission_success_rate", "dt_av_m", "dt_hv_m", "dt_mission_m", "dt_mean_m",
           "hard_brakings_av")  # fmt: skip
PAID = ("dt_av_m", "dt_hv_m", "dt_mission_m", "dt_mean_m", "mission_success_rate", "collision_rate")
AXES = (("dt_mission_m", "mission vehicle, m"), ("dt_hv_m", "HVs, m"))


def arm(phi: float) -> str:
    """Its name in tables."""
    return f"{AGENT}, phi {phi:g}"


def orders() -> list[Order]:
    """Every phi and every yardstick in every contested world."""
    agents = [(Agent(AGENT), phi, arm(phi)) for phi in PHIS]
    agents += [(Agent(name), phi, "") for name, phi in YARDSTICKS]
    return [
        Order(agent, world, DEMAND, BEHAVIOR, EPISODES, phi, name)
        for world in WITH_MISSION
        for agent, phi, name in agents
    ]


def write(results: Results, settings: Settings) -> None:
    """phi.md, phi.svg, data/phi.csv."""
    page = heading(JOB, results, settings, f"Demand `{DEMAND}`, HVs {BEHAVIOR}.")
    lines: list[Line] = []
    runs = results.runs()
    driven = {one.order.arm or one.order.name: one for one in results.driven if one.rows}
    worlds = [w for w in WITH_MISSION if any(of_world(run, w) for run in runs.values())]
    if worlds:
        page += [_picture(runs, driven, worlds, settings), ""]
        page += [
            "Up and to the right is better for all. The line joins one network's phi from 0 (small) to 90"
        ]
        page += ["degrees (large); bars are 95 % intervals of the means.", ""]
    egoist = driven[arm(PHIS[0])].name if arm(PHIS[0]) in driven else ""
    for world in worlds:
        page += [f"## {world}", "", *table(world, runs, FIGURES)]
        lines += lines_of(f"{DEMAND}, {BEHAVIOR}", [world], runs, FIGURES)
        pairs = {}
        for phi in PHIS[1:]:
            if egoist and arm(phi) in driven:
                name = driven[arm(phi)].name
                pairs[name] = differences(runs[egoist], runs[name])
        pairs = {name: {w: c for w, c in compared.items() if w == world} for name, compared in pairs.items()}
        for name, compared in pairs.items():
            lines += difference_lines(f"{DEMAND}, {BEHAVIOR}", name, egoist, compared, PAID)
        if pairs:
            page += [f"Who pays, who gains: less `{egoist}`, paired:", ""]
            page += difference_table({n: c[world] for n, c in pairs.items() if c}, PAID)
    save(JOB, settings, page, lines)


def _picture(runs: dict[str, Run], driven: dict[str, Driven], worlds: list[str], settings: Settings) -> str:
    """A column per world: the AVs' distance against the mission vehicle's, and against the HVs'."""
    picture = drawing(3.4 * len(worlds), 6.0)
    every = picture.subplots(len(AXES), len(worlds), squeeze=False)
    for column, world in enumerate(worlds):
        for axes, (figure, title) in zip(every[:, column], AXES, strict=True):
            path = [driven[arm(phi)].name for phi in PHIS if arm(phi) in driven]
            points = [point for name in path if (point := _point(runs[name], world, figure))]
            sizes = np.linspace(3.0, 9.0, max(len(points), 2))
            if points:
                axes.plot([p[0] for p in points], [p[1] for p in points], color="C0", alpha=0.5, label=AGENT)
            for (x, y, xerr, yerr), size in zip(points, sizes, strict=False):
                axes.errorbar(x, y, yerr, xerr, fmt="o", ms=size, color="C0", elinewidth=0.7)
            for k, (name, _) in enumerate(YARDSTICKS):
                point = _point(runs[driven[name].name], world, figure) if name in driven else None
                if point:
                    x, y, xerr, yerr = point
                    axes.errorbar(x, y, yerr, xerr, fmt="s^D"[k], ms=6, color=f"C{k + 1}", label=name)
            axes.set(xlabel="AVs, m", ylabel=title, title=world)
            axes.grid(alpha=0.3)
    every[0, 0].legend(fontsize="small")
    return save_picture(picture, settings.out / "phi.svg")


def _point(run: Run, world: str, figure: str) -> tuple[float, float, np.ndarray, np.ndarray] | None:
    """The AVs' mean distance, that of `figure`, and the lengths of their bars, m; None where one is NA."""
    x, y = (found(of_world(run, world), Measure(n, n, "m", "higher"))[0] for n in ("dt_av_m", figure))
    if not (x.known and y.known):
        return None
    bars = [np.nan_to_num([[f.value - f.low], [f.high - f.value]]).clip(0.0) for f in (x, y)]
    return x.value, y.value, bars[0], bars[1]


JOB = Job("phi", "phi from 0 to 90 degrees: who pays, who gains", orders, write)

if __name__ == "__main__":
    JOB.main()
