"""P's Table III: six approaches in five worlds, and beside it what the mask and the predicted maps each do.

python -m benchmarks.papers.table3 [--scale 1] [--scenario merge] [--dry-run]
"""

from __future__ import annotations

import itertools

import numpy as np

from benchmarks.arms import differences, of_world
from benchmarks.papers.agents import Agent
from benchmarks.papers.claims import APPROACHES, TABLE_3, VFN, VFN_P
from benchmarks.papers.driving import WORLDS, Order, Results, Settings
from benchmarks.papers.pages import Job, drawing, heading, save, save_picture
from benchmarks.tables import difference_lines, difference_table, found, lines_of, markdown_row, table
from cosim.report.figures import RATES
from cosim.report.run_folder import Run
from cosim.report.statistics import Figure, share
from cosim.workers.tasks import OK

MOST = 1000  # episodes a world of VFN and VFN + P: 1 % against 2 % needs many
OTHERS = 300  # of the baselines
FEW = 100  # of the ablation and the references
REFERENCES = ("keep-lane", "idm")  # how hard the traffic is; what SUMO's own driver makes of it
FIGURES = ("collision_rate", "av_caused_collision_rate", "dt_mean_m", "mission_success_rate", "veto_rate")
COMPARED = ("collision_rate", "av_caused_collision_rate", "dt_mean_m", "mission_success_rate")

# Predicted maps yes or no x mask none, constant speed, Gaussian process; VFN_P and VFN are two of them.
ABLATION = (
    Agent("maps, no mask", VFN_P, mask="none"),
    Agent("maps, mask cs", VFN_P, mask="cs"),
    Agent(VFN_P),
    Agent("no maps, no mask", VFN, mask="none"),
    Agent(VFN),
    Agent("no maps, mask gp", VFN, mask="gp-indirect"),
)
TRAINING = (
    "",
    "Our networks saw two drives an iteration, a demonstrator's among them (training.md); P's saw",
    "thousands of episodes and no demonstrator.",
)
ABLATED = (
    "Ablation: predicted maps yes or no, mask none, constant speed or Gaussian process. The networks are",
    f"those of `{VFN_P}` (maps) and `{VFN}` (no maps), each trained with its own mask;",
    "with maps, the mask's predictor is the chain's too.",
    "",
)


def orders() -> list[Order]:
    """Every approach, reference and ablation in every world, `dense`, mixed."""
    wanted = dict.fromkeys((*ABLATION, *map(Agent, REFERENCES)), FEW)
    wanted |= {Agent(name): OTHERS for name in APPROACHES}
    found = []
    for world in WORLDS:
        wanted |= {Agent(name): enough(world) for name in (VFN, VFN_P)}
        found += [Order(agent, world, "dense", "mixed", episodes) for agent, episodes in wanted.items()]
    return found


def enough(world: str) -> int:
    """MOST, or as many hundreds as it takes that the bound of none crashed lies below P's of VFN + P."""
    claimed = TABLE_3[world][VFN_P] / 100.0
    return next(n for n in itertools.count(MOST, 100) if share(0, n).high < claimed)


def write(results: Results, settings: Settings) -> None:
    """table3.md, table3.svg, data/table3.csv."""
    names = {one.order.name: one.name for one in results.driven if one.rows}  # arm -> as tables show it
    runs = results.runs()
    six = {names[a]: runs[names[a]] for a in (*APPROACHES, *REFERENCES) if a in names}
    ablated = {names[a.name]: runs[names[a.name]] for a in ABLATION if a.name in names}
    worlds = [w for w in WORLDS if any(of_world(run, w) for run in runs.values())]
    page = heading(
        *(JOB, results, settings), "Demand `dense`, HVs `mixed` in equal parts, phi 45 degrees.", *TRAINING
    )
    lines = lines_of("dense", worlds, runs, FIGURES)
    if worlds:
        page += [_picture(six, names, worlds, settings), ""]
        page += against_p(runs, names, worlds)
        page += fewest(runs, names, worlds)
    for world in worlds:
        page += [f"## {world}", "", *table(world, six, FIGURES)]
        ours = names.get(VFN_P)
        others = [names[a] for a in APPROACHES[:-1] if a in names]
        if ours and others:
            pairs = {other: differences(runs[other], runs[ours]) for other in others}
            for other, compared in pairs.items():
                mine = {w: c for w, c in compared.items() if w == world}
                lines += difference_lines("dense", ours, other, mine, COMPARED)
            page += [f"`{ours}` less each of the others, paired:", ""]
            page += difference_table({o: c[world] for o, c in pairs.items() if world in c}, COMPARED)
        if ablated:
            page += [*ABLATED, *table(world, ablated, FIGURES)]
    save(JOB, settings, page, lines)


def against_p(runs: dict[str, Run], names: dict[str, str], worlds: list[str]) -> list[str]:
    """C% beside P's, called below it only where Wilson's upper bound is."""
    page = ["## Crashes in % of episodes, beside P's Table III", ""]
    page += ["`below` only where the upper bound of the interval is below P's figure.", ""]
    page += [markdown_row(["", *worlds]), "|---" * (len(worlds) + 1) + "|"]
    for approach in APPROACHES:
        cells = []
        for world in worlds:
            claimed = TABLE_3[world][approach]
            run = runs.get(names.get(approach, ""))
            figure, counts = crashes(run, world)
            if not figure.known:
                cells.append(f"not run yet (P {claimed})")
                continue
            verdict = "below" if 100.0 * figure.high < claimed else "not below"
            cells.append(f"{counts} = {figure.text(2, 100.0)}, {verdict} P's {claimed}")
        page.append(markdown_row([names.get(approach, approach), *cells]))
    return [*page, ""]


def fewest(runs: dict[str, Run], names: dict[str, str], worlds: list[str]) -> list[str]:
    """Who crashes least in each world, on the seeds that all approaches driven so far have in common."""
    present = [a for a in APPROACHES if a in names]
    if len(present) < 2:
        return []
    page = [
        f"Fewest crashes, on the seeds that {len(present)} of {len(APPROACHES)} approaches have in common:",
        "",
    ]
    for world in worlds:
        counted, seeds = crashes_in_common({a: runs[names[a]] for a in present}, world)
        if not seeds:
            continue
        least = min(counted.values())
        best = [a for a, hits in counted.items() if hits == least]
        tie = " (tie)" if len(best) > 1 else ""
        page.append(f"- {world}: {', '.join(f'`{a}`' for a in best)}{tie} with {least} of {seeds};"
                    f" {', '.join(f'{a} {hits}' for a, hits in counted.items())}")  # fmt: skip
    return [*page, ""]


def crashes(run: Run | None, world: str) -> tuple[Figure, str]:
    """C% as a share and `hits/n`."""
    figure, counts = found([] if run is None else of_world(run, world), RATES["collision_rate"])
    return figure, f"{counts['hits']}/{counts['n']}"


def crashes_in_common(runs: dict[str, Run], world: str) -> tuple[dict[str, int], int]:
    """Approach -> crashed episodes among the seeds that all drove to the end, and how many these are."""
    crashed = {
        name: {row["seed"]: bool(row["crashed"]) for row in of_world(run, world) if row["status"] == OK}
        for name, run in runs.items()
    }
    seeds = set.intersection(*(set(of_seed) for of_seed in crashed.values()))
    return {name: sum(of_seed[s] for s in seeds) for name, of_seed in crashed.items()}, len(seeds)


def _picture(runs: dict[str, Run], names: dict[str, str], worlds: list[str], settings: Settings) -> str:
    """C% by world and approach with intervals; P's figures as crosses."""
    picture = drawing(2.2 + 1.9 * len(worlds), 3.6)
    axes = picture.subplots()
    arms = {name: arm for arm, name in names.items()}
    shown = {name: arms[name] for name in runs}  # in P's order
    for k, (name, arm) in enumerate(shown.items()):
        shift = 0.8 * ((k + 0.5) / len(shown) - 0.5)
        for w, world in enumerate(worlds):
            figure, _ = crashes(runs[name], world)
            label = name if w == 0 else None
            ends = np.clip([[figure.value - figure.low], [figure.high - figure.value]], 0.0, None)
            axes.errorbar(
                w + shift,
                100 * figure.value,
                100 * ends,
                fmt="o",
                ms=4,
                capsize=2,
                color=f"C{k}",
                label=label,
            )
            if arm in APPROACHES:
                claimed = "P's figures" if w == 0 and arm == VFN_P else None
                axes.plot(w + shift, TABLE_3[world][arm], "x", ms=5, color="0.4", label=claimed)
    axes.set_xticks(range(len(worlds)), worlds)
    axes.set(ylabel="episodes with a crash, %", yscale="symlog", ylim=(0.0, 110.0))
    axes.set_yticks([0, 0.5, 1, 2, 5, 10, 20, 50, 100], ["0", "0.5", "1", "2", "5", "10", "20", "50", "100"])
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize="small", bbox_to_anchor=(1.0, 1.0), loc="upper left")
    return save_picture(picture, settings.out / "table3.svg")


JOB = Job("table3", "Table III of P: six approaches in five worlds", orders, write)

if __name__ == "__main__":
    JOB.main()
