"""What a network learned: let in or not, waiting, distances, crashes, against the others on equal seeds.

    python -m benchmarks.learned POLICY [--episodes 20] [--demand contested] [--errors none stress]
        [--others idm altruist-rule] [--seeds-from 200000] [--runs runs/learned] [--workers 2]
        [--out docs/results/learned.md]

POLICY (a name, weights or a training's folder) drives at 60 degrees and at 0, beside `idm` and
`altruist-rule` (or `--others`) at 60 degrees, in preset `lawful`. The same command goes on where it stopped.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.tables import markdown_row, write_page
from benchmarks.worlds import WITH_MISSION
from cosim.cli.main import main as cosim
from cosim.report import run_folder, statistics
from cosim.report.figures import Row
from cosim.scenario.policy_name import label, read
from cosim.seeding import FIRST_TEST_SEED
from cosim.workers.tasks import OK

SVO = 60
MINE, THEIRS = "network", "others"  # folders of runs
OTHERS = ("idm", "altruist-rule")
COLUMNS = (
    "arm", "episodes", "mission vehicle served", "its time, s", "episodes with an AV in a collision",
    "AV-caused", "distance of the mission vehicle, m", "of AVs, m", "of all, m", "hard brakings of AVs",
    "near-misses of AVs", "interventions",
)  # fmt: skip

Arm = tuple[str, float]  # policy, degrees


def of(rows: Sequence[Row], name: str) -> list[float]:
    """One figure of all episodes; nan where it is NA."""
    return [math.nan if row.get(name) is None else float(row[name]) for row in rows]


def share(rows: Sequence[Row], name: str) -> str:
    """The share of episodes with this figure, of those where it is not NA, with its interval."""
    hits = [bool(row[name]) for row in rows if row.get(name) is not None]
    return f"{statistics.share(sum(hits), len(hits)).text(0, 100.0)} %" if hits else "-"


def line(arm: str, rows: Sequence[Row]) -> list[str]:
    """The cells of one arm in one world."""

    def shares(name: str) -> str:
        return share(rows, name)

    def means(name: str, digits: int = 0) -> str:
        return statistics.mean(of(rows, name)).text(digits)

    return [
        *(arm, str(len(rows)), shares("mission_success"), means("mission_time_s", 1)),
        *(shares("av_involved_collisions"), shares("av_caused_collisions")),
        *(means("dt_mission_m"), means("dt_av_m"), means("dt_mean_m"), means("hard_brakings_av", 1)),
        *(means("av_near_misses_ttc", 1), means("interventions", 1)),
    ]


def against(rows: Mapping[Arm, Mapping[int, Row]], first: Arm, other: Arm) -> str:
    """Differences first - other on equal seeds, in a sentence."""
    seeds = sorted(rows[first].keys() & rows[other].keys())
    mine, theirs = ([rows[arm][seed] for seed in seeds] for arm in (first, other))
    parts = []
    for name, what in (
        ("mission_success", "served"),
        ("av_involved_collisions", "episodes with an AV in a collision"),
    ):
        before, after = ([bool(row.get(name)) for row in part] for part in (theirs, mine))
        change = statistics.paired_share(before, after).text(0, 100.0)
        p = statistics.mcnemar(*statistics.discordant(before, after))
        parts.append(f"{what} {change} points, p {p:.2g}")
    for name, what in (
        ("mission_time_s", "its time"),
        ("dt_av_m", "distance of AVs"),
        ("dt_mean_m", "of all"),
        ("av_near_misses_ttc", "near-misses of AVs"),
    ):
        unit = {"s": " s", "m": " m"}.get(name.rpartition("_")[2], "")
        parts.append(f"{what} {statistics.paired_mean(of(theirs, name), of(mine, name)).text(1)}{unit}")
    return f"- less {other[0]} at {other[1]:g} degrees ({len(seeds)} pairs): {'; '.join(parts)}."


def drivers(rows: Sequence[Row]) -> str:
    """Who drives beside the AVs."""
    return ", ".join(sorted({f"{row['behavior']} drivers (`{row['driver_model']}`)" for row in rows}))


def page(
    runs: Path, policy: str, others: Sequence[str], levels: Sequence[str], about: Sequence[str]
) -> list[str]:
    """The Markdown page of whatever has been driven."""
    name, *beside = (label(read(one).text) for one in (policy, *others))
    first, twin = (name, float(SVO)), (name, 0.0)
    arms: list[Arm] = [first, twin, *((other, float(SVO)) for other in beside)]
    kept = [r for part in (MINE, THEIRS) for r in run_folder.read(runs / part).rows if r["status"] == OK]
    lines = ["# What a network learned", "", *about, ""]
    for level in levels:
        for world in WITH_MISSION:
            found: dict[Arm, dict[int, Row]] = {
                arm: {
                    int(row["seed"]): row
                    for row in kept
                    if (row["policy"], float(row["svo_deg"])) == arm
                    and (row["scenario"], row["errors"] or "none") == (world, level)
                }
                for arm in arms
            }
            found = {arm: rows for arm, rows in found.items() if rows}
            if first not in found:
                continue
            lines += [f"## {world}, errors `{level}`", "", markdown_row(COLUMNS)]
            lines += [markdown_row(["---"] * len(COLUMNS))]
            lines += [
                markdown_row(line(f"{who} at {degrees:g} degrees", list(rows.values())))
                for (who, degrees), rows in found.items()
            ]
            lines += ["", *(against(found, first, other) for other in found if other != first), ""]
    return lines


def options(parser: argparse.ArgumentParser, name: str, demand: str, worlds: Sequence[str]) -> None:
    """What a page `name` of episodes on test seeds is asked for, with its usual demand and worlds."""
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--demand", default=demand)
    parser.add_argument("--worlds", nargs="+", default=list(worlds), choices=worlds)
    parser.add_argument("--seeds-from", type=int, default=FIRST_TEST_SEED)
    parser.add_argument("--duration", metavar="S", help="counted s an episode; default: the worlds' own")
    parser.add_argument("--runs", type=Path, default=Path("runs", name), help="where episodes are kept")
    parser.add_argument("--workers", default="2")
    parser.add_argument("--out", type=Path, default=Path("docs/results", f"{name}.md"))


ASKED = (
    *("episodes", "demand", "errors", "worlds", "seeds_from", "duration"),
    *("others", "arms", "weights"),
)


def asked(parser: argparse.ArgumentParser, args: argparse.Namespace) -> str:
    """The options that say which episodes, as far as they are not the usual ones; a space before each."""
    words = []
    for name in ASKED:
        value = getattr(args, name, None)
        if value != parser.get_default(name):
            text = " ".join(value) if isinstance(value, list) else value
            words.append(f" --{name.replace('_', '-')} {text}")
    return "".join(words)


def driving(args: argparse.Namespace) -> list[str]:
    """What `cosim evaluate` is told of `options`, but for the worlds and the place of the episodes."""
    words = ["--demand", args.demand, "--seeds", f"{args.seeds_from}:{args.seeds_from + args.episodes}"]
    words += ["--duration", args.duration] if args.duration else []
    return [*words, "--workers", args.workers, "--resume"]


def main() -> None:
    """Drive what is missing, write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy")
    parser.add_argument("--others", nargs="+", default=list(OTHERS), metavar="NAME", help="beside it")
    parser.add_argument("--errors", nargs="+", default=["none", "stress"])
    options(parser, "learned", "contested", WITH_MISSION)
    args = parser.parse_args()
    seeds = f"{args.seeds_from}:{args.seeds_from + args.episodes}"
    where = [word for world in args.worlds for word in ("--scenario", world)]
    where += [word for level in args.errors for word in ("--errors", level)]
    for part, policies, phi in (
        (MINE, [args.policy], ("0", str(SVO))),
        (THEIRS, args.others, (str(SVO),)),
    ):
        words = [word for policy in policies for word in ("--policy", policy)]
        words += [word for degrees in phi for word in ("--svo", degrees)]
        code = cosim(["evaluate", *where, *words, *driving(args), "--out", str(args.runs / part)])
        if code:
            raise SystemExit(code)
    rows = run_folder.read(args.runs / MINE).rows
    about = [
        f"`{args.demand}`, {drivers(rows)}, seeds {seeds}, preset `lawful`, in the worlds with a mission"
        " vehicle.",
        "Shares with Wilson's, means and paired differences with bootstrap and Tango's 95 % intervals; p by",
        "McNemar, one test a world and figure, not corrected for how many there are.",
        "",
        f"Made by `python -m benchmarks.learned {args.policy}{asked(parser, args)}`.",
    ]
    write_page(args.out, page(args.runs, args.policy, args.others, args.errors, about))
    print(args.out.read_text())


if __name__ == "__main__":
    main()
