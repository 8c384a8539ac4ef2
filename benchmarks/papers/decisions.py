"""What the learned decisions are worth: our VFN + P against its egoistic twin, the scripted altruist and IDM.

    python -m benchmarks.papers.decisions [--scale 1] [--scenario merge] [--dry-run]

300 episodes a world of `dense` with mixed drivers, 100 of `contested`, on test seeds, `unguarded`; each
target of `benchmarks/targets.py` beside its figure. What Table III has driven already is not driven again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from benchmarks import targets
from benchmarks.arms import differences, of_world
from benchmarks.papers.agents import Agent
from benchmarks.papers.claims import VFN, VFN_P
from benchmarks.papers.driving import WORLDS, Order, Results, Settings
from benchmarks.papers.pages import Job, heading, save
from benchmarks.tables import (
    COLUMNS,
    Line,
    difference_lines,
    difference_table,
    found,
    lines_of,
    markdown_row,
    picture,
    table,
)
from benchmarks.targets import Arms, Finding
from cosim.report.run_folder import Run
from cosim.report.statistics import Figure

DENSE, CONTESTED = 300, 100  # episodes a world
TWIN = "vfn-p-egoistic"
AGENTS = (VFN_P, VFN, TWIN, "altruist-rule", "idm", "keep-lane")
ELSEWHERE = {  # (agent, demand) that this page does without
    ("keep-lane", "contested"),  # nobody needs to see how hard that traffic is
    (VFN, "dense"),  # Table III has it, with more episodes
}
BEHAVIOR = {"dense": "mixed", "contested": "moderate"}  # presets.md, Human drivers
DIFFERENCES = (
    "mission_success_rate",
    "collision_rate",
    "dt_mission_m",
    "dt_av_m",
    "dt_mean_m",
    "hard_brakings_av",
)
PANELS = (  # demand, figure, title
    ("dense", "collision_rate", "C%, dense"),
    ("contested", "mission_success_rate", "served, contested"),
    ("contested", "dt_mission_m", "DT of the mission vehicle, contested"),
    ("contested", "dt_av_m", "DT of the AVs, contested"),
)
PERCENT = tuple(title for _, name, title in PANELS if name.endswith("_rate"))

Runs = Mapping[str, Mapping[str, Run]]  # demand -> arm -> its episodes


def orders() -> list[Order]:
    """Everybody in every world and both demands, but for `ELSEWHERE`."""
    return [
        Order(Agent(name), world, demand, behavior, episodes, svo_deg=svo(name))
        for demand, behavior, episodes in (
            ("contested", BEHAVIOR["contested"], CONTESTED),
            ("dense", BEHAVIOR["dense"], DENSE),
        )
        for world in WORLDS
        for name in AGENTS
        if (name, demand) not in ELSEWHERE
    ]


def svo(name: str) -> float:
    """phi in degrees: the twin was trained for itself alone, and drives so."""
    return 0.0 if name == TWIN else 45.0


def write(results: Results, settings: Settings) -> None:
    """decisions.md, decisions.png, data/decisions.csv."""
    runs = {demand: results.runs(demand=demand) for demand in BEHAVIOR}
    names = {one.order.name: one.name for one in results.driven if one.rows}
    driven = {row["scenario"] for arms in runs.values() for run in arms.values() for row in run.rows}
    worlds = [world for world in WORLDS if world in driven]
    about = (
        f"phi 45 degrees, `{TWIN}` 0. DT: mean distance in m over the fixed duration; nobody drives on",
        "after a crash. The unguarded `keep-lane` fleet shows how hard the traffic is.",
    )
    page = heading(JOB, results, settings, *about)
    findings = list(found_targets(runs, worlds, names))
    page += target_lines(findings)
    if worlds:
        settings.out.mkdir(parents=True, exist_ok=True)
        picture(settings.out / "decisions.png", panels(runs, worlds), PERCENT)
        page += ["![crashes, missions, distances](decisions.png)", ""]
    page += headline(runs, worlds, names)
    page += figures(runs, worlds, names)
    save(JOB, settings, page, csv_lines(runs, worlds, names))


def found_targets(runs: Runs, worlds: Sequence[str], names: Mapping[str, str]) -> Iterator[Finding]:
    """Every target whose arms were driven; `names`: arm -> as the tables show it."""
    parts = Arms(*(names.get(a, "") for a in (VFN_P, TWIN, "idm", "altruist-rule")))
    if {parts.agent, parts.idm} <= runs["dense"].keys():
        yield from targets.dense(runs["dense"], worlds, parts)
    if set(parts) <= runs["contested"].keys():
        yield from targets.contested(runs["contested"], worlds, parts)


def target_lines(findings: Sequence[Finding]) -> list[str]:
    """The targets: first which are missed, then all of them with their figures."""
    if not findings:
        return [f"The targets need `{VFN_P}`, its twin, `altruist-rule` and `idm`: not driven yet.", ""]
    missed = [f"- {f.world}, {f.demand}: {f.target} ({f.found})" for f in findings if not f.met]
    first = f"{len(findings) - len(missed)} of {len(findings)} are met by their value"
    return [
        "## Targets",
        "",
        *([f"{first}; missed:", "", *missed] if missed else [f"{first}."]),
        "",
        *_findings(findings, "target", "verdict"),
    ]


def headline(runs: Runs, worlds: Sequence[str], names: Mapping[str, str]) -> list[str]:
    """T's claim, tested in both demands."""
    agent, twin = names.get(VFN_P, ""), names.get(TWIN, "")
    tested = [
        finding
        for demand, arms in runs.items()
        if {agent, twin} <= arms.keys()
        for finding in targets.altruists_against_twin(demand, arms[twin], arms[agent], worlds)
    ]
    if not tested:
        return []
    return [
        "## Altruists against egoists",
        "",
        f"T's headline: altruists crash less and everybody gets further. `{agent}` - `{twin}`, equal seeds.",
        "",
        *_findings(tested, "claim", "tested"),
    ]


def figures(runs: Runs, worlds: Sequence[str], names: Mapping[str, str]) -> list[str]:
    """The tables of every world: the arms, and the agent's differences to them."""
    page = []
    for demand, arms in runs.items():
        for world in worlds:
            if not any(of_world(run, world) for run in arms.values()):
                continue
            page += [f"## {world}, {demand}", "", f"Drivers {BEHAVIOR[demand]}.", "", *table(world, arms)]
            agent = names.get(VFN_P, "")
            compared = {
                f"{agent} - {other}": differences(arms[other], arms[agent])[world]
                for other in _others(names)
                if {agent, other} <= arms.keys()
            }
            if compared:
                page += difference_table(compared, DIFFERENCES)
    return page


def csv_lines(runs: Runs, worlds: Sequence[str], names: Mapping[str, str]) -> list[Line]:
    """Every figure and every paired difference of the page."""
    lines: list[Line] = []
    agent = names.get(VFN_P, "")
    for demand, arms in runs.items():
        lines += lines_of(demand, worlds, arms, COLUMNS)
        for other in _others(names):
            if {agent, other} <= arms.keys():
                compared = differences(arms[other], arms[agent])
                lines += difference_lines(demand, agent, other, compared, DIFFERENCES)
    return lines


def panels(runs: Runs, worlds: Sequence[str]) -> dict[str, dict[str, dict[str, Figure]]]:
    """Title -> arm -> world -> figure."""
    out: dict[str, dict[str, dict[str, Figure]]] = {}
    for demand, name, title in PANELS:
        for arm, run in runs[demand].items():
            known = {w: found(of_world(run, w), run.measures[name])[0] for w in worlds}
            out.setdefault(title, {})[arm] = {w: f for w, f in known.items() if f.known}
    return out


# ---- inside ----


def _others(names: Mapping[str, str]) -> list[str]:
    return [names[name] for name in ("idm", TWIN, "altruist-rule", VFN) if name in names]


def _findings(findings: Sequence[Finding], what: str, verdict: str) -> list[str]:
    head = [markdown_row(["demand", "world", what, "found", verdict]), "|---|---|---|---|---|"]
    return [*head, *(markdown_row(list(finding)) for finding in findings), ""]


JOB = Job("decisions", "What the learned decisions are worth", orders, write)

if __name__ == "__main__":
    JOB.main()
