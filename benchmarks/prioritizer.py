"""How much hangs on the safety prioritizer's thresholds: crashes, vetoes and distance, one setting at a time.

    python -m benchmarks.prioritizer [--scale 1] [--scenario merge] [--dry-run]

Tuning seeds (100,000 on): what is compared here may change the defaults. Three agents ask the prioritizer:
one to which every action is worth the same (`cruise`: keeps lane and speed while it may), one whose
preferences are `random`, and vfn-p-demonstrated once trained.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from benchmarks.arms import differences, of_world
from benchmarks.papers.agents import Agent, missing
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
from cosim.report.run_folder import Run
from cosim.report.statistics import Figure
from cosim.seeding import TUNING_SEEDS
from policy.safety import SafetyConfig

WORLDS = ("merge", "intersection")  # one where lanes meet, one where ways cross
EPISODES = 6  # a world and setting; --scale for more
DEFAULT = SafetyConfig()
AGENTS = {
    "cruise": Agent("cruise", VFN_P, preference="none"),
    "random": Agent("random", VFN_P, preference="random"),
    VFN_P: Agent(VFN_P),
}
COLUMNS = (
    "collision_rate",
    "av_caused_collision_rate",
    "veto_rate",
    "fallback_rate",
    "dt_mean_m",
    "dt_av_m",
    "hard_brakings_av",
    "mission_success_rate",
)
PANELS = {"C%": "collision_rate", "vetoed": "veto_rate", "DT all": "dt_mean_m"}
PERCENT = ("C%", "vetoed")
DIFFERENCES = ("collision_rate", "veto_rate", "dt_mean_m", "hard_brakings_av")


@dataclass(frozen=True, slots=True)
class Setting:
    """What differs from the default."""

    name: str
    safety: SafetyConfig = DEFAULT
    mask: Literal["", "none", "cs"] = ""
    share_intentions: bool = True
    share_perception: bool = True

    def applied(self, agent: Agent) -> Agent:
        """The same agent with this setting; the default's is the agent itself."""
        if self == SETTINGS[0]:
            return agent
        return replace(
            agent,
            name=f"{agent.name}, {self.name}",
            policy=agent.base,
            safety=self.safety,
            mask=self.mask,
            share_intentions=self.share_intentions,
            share_perception=self.share_perception,
        )


def margins(along: float, across: float) -> SafetyConfig:
    """m added to the ego's box."""
    return replace(DEFAULT, margin_length=along, margin_width=across)


SETTINGS = (
    Setting("default"),
    Setting("safe_th 2 s", replace(DEFAULT, safe_th=2.0)),
    Setting("safe_th 4 s", replace(DEFAULT, safe_th=4.0)),
    Setting("safe_th 5 s", replace(DEFAULT, safe_th=5.0)),
    Setting("critical_th 0.75 s", replace(DEFAULT, critical_th=0.75)),
    Setting("critical_th 2.5 s", replace(DEFAULT, critical_th=2.5)),
    Setting("horizon 2 s", replace(DEFAULT, horizon=2.0)),
    Setting("contacts within 1.5 s", replace(DEFAULT, horizon=1.0, critical_th=0.5, safe_th=0.5)),
    Setting("held to the end (P)", replace(DEFAULT, brake_after=60.0)),
    Setting("brake after 1.6 s", replace(DEFAULT, brake_after=1.6)),
    Setting("lambda 2 /s", replace(DEFAULT, decay=2.0)),
    Setting("no margins", margins(0.0, 0.0)),
    Setting("margins doubled", margins(2 * DEFAULT.margin_length, 2 * DEFAULT.margin_width)),
    Setting("leaders brake with 5 m/s2", replace(DEFAULT, leader_brake=5.0)),
    Setting("followers may brake with 6 m/s2", replace(DEFAULT, follower_brake=6.0)),
    Setting("constant speed", mask="cs"),
    Setting("no intentions", share_intentions=False),
    Setting("no V2V", share_intentions=False, share_perception=False),
    Setting("no mask", mask="none"),
)


def orders() -> list[Order]:
    """Every setting in every world, for the agent without preferences and, once there is one, the trained."""
    return [
        Order(setting.applied(agent), world, "dense", "mixed", EPISODES)
        for agent in AGENTS.values()
        for world in WORLDS
        for setting in (SETTINGS[:1] if missing(agent) else SETTINGS)
    ]


def write(results: Results, settings: Settings) -> None:
    """prioritizer.md, prioritizer.png, data/prioritizer.csv."""
    runs = results.runs()
    names = {one.order.name: one.name for one in results.driven if one.rows}
    default = DEFAULT
    page = heading(
        *(JOB, results, settings),
        "Demand `dense`, HVs `mixed`. Default: safe_th "
        f"{default.safe_th:g} s, critical_th {default.critical_th:g} s, lambda {default.decay:g} /s, margins",
        f"{default.margin_length:g} m along and {default.margin_width:g} m across, leaders brake with up to "
        f"{default.leader_brake:g} m/s2, followers need not with more than {default.follower_brake:g};",
        f"a car ahead in the own lane counts if braking after {default.brake_after:g} s would touch it.",
        "`cruise`: every action is worth the same, so the agent keeps lane and speed while the prioritizer",
        "lets it; without a mask that is the unguarded `keep-lane`. `random`: drawn anew at every decision.",
        "",
        *_bites(default),
    )
    lines: list[Line] = []
    for agent in AGENTS.values():
        mine = {s.name: runs[names[n]] for s in SETTINGS if (n := s.applied(agent).name) in names}
        worlds = [w for w in WORLDS if any(of_world(run, w) for run in mine.values())]
        if not worlds:
            continue
        file = f"prioritizer-{agent.name}.png"
        settings.out.mkdir(parents=True, exist_ok=True)
        picture(settings.out / file, panels(mine, worlds), PERCENT)
        page += [f"## {agent.name}", "", f"![{agent.name}: crashes, vetoes, distance]({file})", ""]
        compared = {n: differences(mine["default"], run) for n, run in mine.items() if n != "default"}
        for world in worlds:
            page += [f"### {agent.name}, {world}", "", *table(world, mine, COLUMNS)]
            here = {n: by_world[world] for n, by_world in compared.items() if world in by_world}
            moved = {n: c for n, c in here.items() if c.group.identical < len(c.group.pairs)}
            if same := [n for n in here if n not in moved]:
                page += [f"Not one decision changed: {', '.join(same)}.", ""]
            if moved:
                page += ["Less the default, paired:", ""]
                page += difference_table(moved, DIFFERENCES, arms_down=True)
        lines += lines_of(f"dense, {agent.name}", worlds, mine, COLUMNS)
        for name, by_world in compared.items():
            lines += difference_lines(f"dense, {agent.name}", name, "default", by_world, DIFFERENCES)
    save(JOB, settings, page, lines)


def _bites(c: SafetyConfig) -> list[str]:
    """Which first contacts each of P's two rules refuses."""
    steps = c.dt * np.arange(1, round(c.horizon / c.dt) + 1)  # s
    ahead = float(np.average(steps, weights=np.exp(-c.decay * steps)))  # s
    critical = c.horizon + c.critical_th
    return [
        "With a first contact T s ahead the time to collision at step h is T - h. So `critical_th` refuses",
        f"every contact within horizon + critical_th = {critical:g} s, and `safe_th` one within safe_th plus",
        f"the weighted mean of h, {c.safe_th + ahead:.1f} s. The first rule covers the second, lambda",
        f"too, until safe_th exceeds {critical - ahead:.1f} s: below that neither can change anything.",
    ]


def panels(runs: Mapping[str, Run], worlds: Sequence[str]) -> dict[str, dict[str, dict[str, Figure]]]:
    """Title -> world -> setting -> figure."""
    return {
        title: {
            world: {
                name: figure
                for name, run in runs.items()
                if (figure := found(of_world(run, world), run.measures[column])[0]).known
            }
            for world in worlds
        }
        for title, column in PANELS.items()
    }


JOB = Job(
    "prioritizer",
    "How much hangs on the prioritizer's thresholds",
    orders,
    write,
    "benchmarks",
    TUNING_SEEDS.start,
)

if __name__ == "__main__":
    JOB.main()
