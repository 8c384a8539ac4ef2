"""One impatient human, nobody else errs: does whoever lets in crash less and get further (T's headline)?

    python -m benchmarks.forced_entry [--episodes 200] [--lag 0.5] [--runs runs/forced_entry] [--page PAGE]
    python -m benchmarks.forced_entry --arms vfn-p@0 vfn-p@45 --section learned [--worlds merge exit]
    python -m benchmarks.forced_entry --arms vfn-p@0 vfn-p@45 --section learned-stress --errors stress

An egoist and an altruist (a policy, at a phi in degrees) in the contested worlds with a mission vehicle, on
equal test seeds, preset `lawful`. The error is `forced_entry` of `stress`; `lag` (s) is the shortest gap that
it takes; with `--errors` it is another level's. Goes on where it stopped, and writes the table into the
section of docs/results/forced_entry.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import yaml

from benchmarks.tables import fill, markdown_row
from benchmarks.worlds import WITH_MISSION
from cosim.cli.main import main as cosim
from cosim.report import run_folder, statistics
from cosim.report.figures import Row
from cosim.report.pairing import errors_begun
from cosim.scenario.human_errors import levels
from cosim.seeding import FIRST_TEST_SEED
from cosim.workers.tasks import OK

PAGE = Path("docs/results/forced_entry.md")
ARMS = ("idm", "altruist-rule")
COLUMNS = (
    *("world", "pairs", "a collision of the mission vehicle or an AV", "difference, pp", "p"),
    *("of an AV", "let in", "difference, pp", "distance of all, more m", "of the mission vehicle", "of AVs"),
)


def forced(lag: float, runs: Path) -> str:
    """The file of a level that has no other error."""
    kind = levels()["stress"].kinds.forced_entry
    assert kind is not None
    runs.mkdir(parents=True, exist_ok=True)
    file = runs / f"forced_{lag:g}.yaml"
    file.write_text(yaml.safe_dump({"forced_entry": asdict(replace(kind, lag=lag))}))
    return str(file)


def drive(arm: str, worlds: Sequence[str], errors: str, seeds: range, out: Path, workers: str) -> list[Row]:
    """What an arm, POLICY or POLICY@PHI, drove: rows of all worlds, by world and seed."""
    policy, _, phi = arm.partition("@")
    words = [word for world in worlds for word in ("--scenario", world)]
    words += ["--demand", "contested", "--errors", errors, "--policy", policy, "--svo", phi or "45"]
    words += ["--seeds", f"{seeds.start}:{seeds.stop}", "--no-report", "--workers", workers]
    if code := cosim(["evaluate", *words, "--resume", "--out", str(out)]):
        raise SystemExit(code)
    rows = [row for row in run_folder.read(out).rows if row["status"] == OK]
    return sorted(rows, key=lambda row: (str(row["scenario"]), int(row["seed"])))


def line(world: str, egoists: Sequence[Row], altruists: Sequence[Row]) -> list[str]:
    """One world's cells, of rows paired in their order."""
    both = egoists, altruists

    def shares(name: str) -> list[str]:
        before, after = (np.array([bool(row[name]) for row in rows]) for rows in both)
        counts = [f"{100 * side.mean():.1f} %" for side in (before, after)]
        p = statistics.mcnemar(*statistics.discordant(before, after))
        return [", ".join(counts), statistics.paired_share(before, after).text(1, 100.0), f"{p:.2g}"]

    def further(name: str) -> str:
        before, after = ([float(row[name] or 0.0) for row in rows] for rows in both)
        return statistics.paired_mean(before, after).text(0)

    crashed, served = shares("crashed"), shares("mission_success")
    hit = (sum(bool(row["av_involved_collisions"]) for row in rows) for rows in both)
    *begun, _ = errors_begun(zip(*both, strict=True))
    return [
        *(world, str(len(egoists)), *crashed, ", ".join(map(str, hit)), *served[:2]),
        *(further(name) for name in ("dt_mean_m", "dt_mission_m", "dt_av_m")),
        ", ".join(map(str, begun)),
    ]


def main() -> None:
    """Drive what is missing, then fill the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=200, help="a world")
    parser.add_argument("--lag", type=float, default=0.5, metavar="S")
    parser.add_argument("--arms", nargs=2, default=ARMS, metavar=("EGOIST", "ALTRUIST"))
    parser.add_argument("--worlds", nargs="+", choices=WITH_MISSION, default=WITH_MISSION)
    parser.add_argument("--errors", help="of this level, not a forced entry alone")
    parser.add_argument("--section", default="forced", help="of the page")
    parser.add_argument("--runs", type=Path, default=Path("runs/forced_entry"))
    parser.add_argument("--workers", default="2")
    parser.add_argument("--page", type=Path, default=PAGE)
    args = parser.parse_args()
    errors = args.errors or forced(args.lag, args.runs)
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.episodes)
    name = Path(args.errors).stem if args.errors else f"lag_{args.lag:g}"
    rows = []
    for arm in args.arms:
        out = args.runs / "-".join((name, str(args.episodes), *args.worlds, arm.replace("/", "_")))
        rows.append(drive(arm, args.worlds, errors, seeds, out, args.workers))
    head = [*COLUMNS, "errors that began" if args.errors else "forced entries"]
    lines = [markdown_row(head), markdown_row(["---"] * len(head))]
    for world in args.worlds:
        egoists, altruists = ([row for row in of if row["scenario"] == world] for of in rows)
        lines += [markdown_row(line(world, egoists, altruists))]
    fill(args.page, args.section, lines)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
