"""Every policy that ships among humans who err (`--errors stress`), in all worlds, dense and contested.

    python -m benchmarks.humans_policies [--episodes 20] [--policy NAME ...] [--runs runs/humans_policies]

All policies drive the same test seeds in preset `lawful` (`keep-lane` always `unguarded`). The
command goes on where it stopped, also with more episodes (in blocks of 20) or further policies, and writes
its tables and pictures into docs/results/humans.md: who is in collisions, how near the others come, and who
erred in front of whom.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.humans import BLOCK, CAR, IDM, LEVEL, PAGE, label
from benchmarks.tables import fill, markdown_row, picture, stacked_bars
from benchmarks.worlds import WITH_MISSION, WORLDS
from cosim.cli.main import main as cosim
from cosim.report import run_folder, statistics, wording
from cosim.report.figures import INCIDENCES, Row
from cosim.scenario.human_errors import KINDS
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import Preset
from cosim.workers.tasks import OK

POLICIES = (
    *(CAR, "keep-lane", "idm", "idm-1.5", "idm-2.2", "altruist-rule", "vfn-p", "vfn", "vfn-p-demonstrated"),
    *("vfn-p-egoistic", "safe-dqn", "conv3d-dqn", "conv3d-a2c", "conv2d-dqn", "vfn-demonstrated"),
)
DEMANDS = ("dense", "contested")
NEAR = {
    "av_near_misses_ttc_per_av_hour": "TTC below 1.5 s",
    "av_near_misses_drac_per_av_hour": "DRAC above 3.35 m/s2",
    "av_near_misses_pet_per_av_hour": "PET below 1 s",
}
COLUMNS = (
    *("policy", *WORLDS, "together", "less idm, pp", "p", "AV-caused", "let in"),
    *("distance of all, m", "of AVs, m", "hard brakings of AVs"),
)
RECENT = {"stalled_car": 135.0}  # s an error may have a part in what follows, at most; others 15
ALTRUISTS = {
    "altruist-rule": "idm",
    "vfn-p-demonstrated": "vfn-p-egoistic",
}  # altruists: egoists
# who erred, of the first collision of an AV -> the column's head
ROLES = {
    "collider": "an erring human drives into an AV",
    "victim": "an AV drives into an erring human",
    "ahead": "one of both is behind an erring human",
    "nobody": "nobody erred",
}


Key = tuple[str, str, int]  # demand, world, seed


def drive(policy: str, seeds: range, runs: Path, workers: str) -> None:
    """These episodes of one policy in all worlds and demands; what is there already is not driven again."""
    matrix = [word for name in WORLDS for word in ("--scenario", name)]
    matrix += [word for name in DEMANDS for word in ("--demand", name)]
    matrix += ["--policy", policy, "--preset", Preset.LAWFUL, "--errors", LEVEL]
    running = ["--seeds", f"{seeds.start}:{seeds.stop}", "--no-report", "--workers", workers, "--resume"]
    out = runs / f"{label(policy)}-{seeds.start}"
    code = cosim(["evaluate", *matrix, *running, "--out", str(out)])
    if code:
        raise SystemExit(code)


def read(runs: Path, policies: Sequence[str], seeds: range) -> dict[str, dict[Key, Row]]:
    """Policy -> rows."""
    found: dict[str, dict[Key, Row]] = {}
    for policy in policies:
        folders = [runs / f"{label(policy)}-{first}" for first in seeds[::BLOCK]]
        rows = [row for folder in folders for row in run_folder.read(folder).rows if row["status"] == OK]
        found[label(policy)] = {(str(r["demand"]), str(r["scenario"]), int(r["seed"])): r for r in rows}
    return found


def hit(row: Row) -> bool:
    """Whether an AV is in a collision."""
    return bool(row["av_involved_collisions"])


def line(policy: str, mine: Mapping[tuple[str, int], Row], idm: Mapping[tuple[str, int], Row]) -> list[str]:
    """One policy's cells in one demand, both by (world, seed)."""
    rows = [*mine.values()]
    each = {world: [hit(row) for key, row in mine.items() if key[0] == world] for world in WORLDS}
    hits, count = sum(map(hit, rows)), len(rows)
    pairs = sorted(mine.keys() & idm.keys())
    before, after = ([hit(side[key]) for key in pairs] for side in (idm, mine))
    less = ["", ""]
    if policy != IDM:
        p = statistics.mcnemar(*statistics.discordant(before, after))
        less = [statistics.paired_share(before, after).text(1, 100.0), f"{p:.2g}"]
    caused = sum(bool(row["av_caused_collisions"]) for row in rows)
    served = [bool(row["mission_success"]) for row in rows if row["mission_success"] is not None]

    def mean(name: str, digits: int = 0) -> str:
        return statistics.mean([float(row[name]) for row in rows if row[name] is not None]).text(digits)

    return [
        *(policy, *(f"{sum(found)} of {len(found)}" for found in each.values())),
        *(f"{statistics.share(hits, count).text(1, 100.0)} %", *less),
        f"{statistics.share(caused, count).text(1, 100.0)} %",
        f"{statistics.share(sum(served), len(served)).text(0, 100.0)} %",
        *(mean("dt_mean_m"), mean("dt_av_m"), mean("hard_brakings_av", 1)),
    ]


def near(policy: str, rows: Sequence[Row]) -> list[str]:
    """Near-misses per AV-hour, with intervals."""
    return [policy, *(wording.interval(INCIDENCES[name].figure(rows), INCIDENCES[name]) for name in NEAR)]


def who_erred(row: Row) -> tuple[str, str]:
    """(Role of `ROLES`, kind of error, "" where unknown) of the first collision of an AV."""
    collisions, errors = (json.loads(row[name]) for name in ("collision_list", "human_error_list"))
    found = [c for c in collisions if c["collider_is_av"] or c["victim_is_av"]]
    first = min((c for c in found if c["kind"] != "insertion"), key=lambda c: float(c["time"]))
    if not first["human_error_involved"]:
        return "nobody", ""
    pair = {first["collider"]: "collider", first["victim"]: "victim"}
    erred = [
        (time, kind, who)
        for kind, who, time in errors
        if who in pair and 0.0 <= first["time"] - time <= RECENT.get(kind, 15.0)
    ]
    if not erred:
        return "ahead", ""
    _, kind, who = max(erred)
    return pair[who], kind


def roles(policy: str, rows: Sequence[Row]) -> list[str]:
    """How often an AV's collision came about in which way, and by which errors most."""
    found = [who_erred(row) for row in rows if hit(row)]
    by_role, by_kind = Counter(role for role, _ in found), Counter(kind for _, kind in found if kind)
    kinds = ", ".join(f"{count} {kind}" for kind, count in by_kind.most_common())
    return [policy, str(len(found)), *(str(by_role[role]) for role in ROLES), kinds]


def headline(altruist: str, egoist: str, world: str, found: Mapping[str, Mapping[Key, Row]]) -> list[str]:
    """T's figure 6 in one contested world: altruists against egoists, on equal seeds."""
    of = [{k[2]: r for k, r in found[p].items() if k[:2] == ("contested", world)} for p in (altruist, egoist)]
    seeds = sorted(of[0].keys() & of[1].keys())
    kind, selfish = ([side[seed] for seed in seeds] for side in of)

    def less(name: str) -> list[str]:
        now, then = ([bool(row[name]) for row in side] for side in (kind, selfish))
        p = statistics.mcnemar(*statistics.discordant(then, now))
        change = statistics.paired_share(then, now).text(0, 100.0)
        return [f"{sum(now)}, {sum(then)}: {change} points, p {p:.2g}"]

    before, after = ([float(row["dt_mean_m"]) for row in side] for side in (selfish, kind))
    return [
        *(world, altruist, egoist, str(len(seeds)), *less("crashed"), *less("mission_success")),
        statistics.paired_mean(before, after).text(0),
    ]


def tables(found: Mapping[str, Mapping[Key, Row]]) -> list[str]:
    """All tables of the page."""
    lines = []
    for demand in DEMANDS:
        of = {p: {k[1:]: row for k, row in rows.items() if k[0] == demand} for p, rows in found.items()}
        lines += [f"### {demand}", "", markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))]
        lines += [markdown_row(line(policy, rows, of[IDM])) for policy, rows in of.items()]
        lines.append("")
    heads: Sequence[str] = ("policy", *NEAR.values())
    lines += ["### Near-misses of AVs per AV-hour", "", markdown_row(heads)]
    lines += [markdown_row(["---"] * len(heads))]
    lines += [markdown_row(near(policy, [*rows.values()])) for policy, rows in found.items()]
    heads = ("policy", "first collisions of an AV", *ROLES.values(), "kinds, of both who collided")
    lines += ["", "### Who erred in front of whom", "", markdown_row(heads)]
    lines += [markdown_row(["---"] * len(heads))]
    lines += [markdown_row(roles(policy, [*rows.values()])) for policy, rows in found.items()]
    heads = ("world", "altruists", "egoists", "pairs", "crashed", "let in", "distance of all: more m")
    lines += ["", "### Altruists against egoists, contested", "", markdown_row(heads)]
    lines += [markdown_row(["---"] * len(heads))]
    both = [pair for pair in ALTRUISTS.items() if found.keys() >= {*pair}]
    return lines + [markdown_row(headline(*pair, w, found)) for w in WITH_MISSION for pair in both]


def draw(found: Mapping[str, Mapping[Key, Row]], path: Path) -> str:
    """Shares of episodes with an AV in a collision, and with one that an AV caused, by policy (Markdown)."""
    panels: dict[str, dict[str, dict[str, statistics.Figure]]] = {}
    for title, name in (
        ("episodes with an AV in a collision", "av_involved_collisions"),
        ("episodes with a collision that an AV caused", "av_caused_collisions"),
    ):
        arms = panels[title] = {}
        for demand in DEMANDS:
            of = {p: [bool(r[name]) for k, r in rows.items() if k[0] == demand] for p, rows in found.items()}
            arms[demand] = {policy: statistics.share(sum(hits), len(hits)) for policy, hits in of.items()}
    picture(path, panels, percent=[*panels])
    return f"![who is in collisions]({path.name})"


def draw_errors(found: Mapping[str, Mapping[Key, Row]], path: Path) -> str:
    """Who erred in an AV's first collision, and how, by policy (Markdown), without `keep-lane`."""
    panels: dict[str, dict[str, dict[str, int]]] = {"who erred": {}, "how": {}}
    for policy, rows in found.items():
        if policy == "keep-lane":
            continue
        erred = [who_erred(row) for row in rows.values() if hit(row)]
        by_role = Counter(role for role, _ in erred)
        panels["who erred"][policy] = {said: by_role[role] for role, said in ROLES.items()}
        by_kind = Counter(kind for _, kind in erred if kind)
        panels["how"][policy] = {kind: by_kind[kind] for kind in KINDS if by_kind[kind]}
    stacked_bars(path, panels, "first collisions of an AV")
    return f"![who erred in front of whom]({path.name})"


def main() -> None:
    """Drive what is missing, then fill the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=20, help="a world and demand")
    parser.add_argument("--policy", nargs="+", default=list(POLICIES))
    parser.add_argument("--runs", type=Path, default=Path("runs/humans_policies"))
    parser.add_argument("--workers", default="2")
    parser.add_argument("--page", type=Path, default=PAGE)
    args = parser.parse_args()
    policies = list(dict.fromkeys([IDM, *args.policy]))
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.episodes)
    for first in seeds[::BLOCK]:
        for policy in policies:
            drive(policy, range(first, min(first + BLOCK, seeds.stop)), args.runs, args.workers)
    found = read(args.runs, policies, seeds)
    found = {name: found[name] for name in map(label, (*POLICIES, *policies)) if name in found}
    pictures = [
        draw(found, args.page.with_name("humans_policies.png")),
        draw_errors(found, args.page.with_name("humans_errors.png")),
    ]
    fill(args.page, "policies", ["", *pictures, "", *tables(found)])
    print("\n".join(tables(found)))


if __name__ == "__main__":
    main()
