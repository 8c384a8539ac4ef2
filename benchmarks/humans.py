"""AVs of preset `lawful` among humans who err (`--errors stress`), beside plain `idm`.

    python -m benchmarks.humans [--episodes 400] [--policy NAME ...] [--runs runs/humans] [--workers 2]

Drives the same test seeds in every world, each in the demand of `DEMAND`, and goes on where it
stopped, also with more episodes (in blocks of 20) or further policies. Its table stands
in docs/results/humans.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.tables import fill, markdown_row
from cosim.cli.main import main as cosim
from cosim.report import run_folder, statistics
from cosim.report.figures import Row
from cosim.report.pairing import errors_begun
from cosim.scenario.policy_name import read as read_name
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import Preset
from cosim.workers.tasks import OK

PAGE = Path("docs/results/humans.md")
# In `contested` most happens; there the AVs of a motorway that nobody disturbs are hit less often.
DEMAND = {
    "merge": "contested",
    "exit": "contested",
    "roundabout": "contested",
    "intersection": "contested",
    "highway": "dense",
}
LEVEL, IDM = "stress", "idm"
CAR = "car-alone"
BLOCK = 20  # seeds that are driven together
COLUMNS = (
    *("world", "demand", "pairs", "policy", "beside"),
    *("an AV in a collision", "beside", "difference, pp", "p"),
    *("an AV caused one", "distance of all, m", "more than beside, m", "hard brakings of AVs", "beside"),
    "errors that began in both",
)


def label(policy: str) -> str:
    """What tables and folders call it."""
    return read_name(policy).label


def rows_of(runs: Path, policy: str) -> dict[tuple[str, int], Row]:
    """(World, seed) -> row, of the demands of `DEMAND`, from all run folders below `runs`."""
    return {
        (str(row["scenario"]), int(row["seed"])): row
        for store in sorted(runs.glob("*/store.sqlite"))
        for row in run_folder.read(store.parent).rows
        if (row["policy"], row["errors"], row["status"]) == (label(policy), LEVEL, OK)
        and row["demand"] == DEMAND[str(row["scenario"])]
    }


def line(
    world: str, policy: str, beside: str, rows: Mapping[str, Mapping[tuple[str, int], Row]]
) -> list[str]:
    """One world's cells, or of all together (""), of two policies' rows paired by seed."""
    keys = sorted(key for key in rows[policy].keys() & rows[beside].keys() if world in ("", key[0]))
    now, then = ([rows[name][key] for key in keys] for name in (policy, beside))

    def column(rows: list[Row], name: str) -> list[float]:
        return [float(row[name] or 0.0) for row in rows]

    caused = sum(value > 0 for value in column(now, "av_caused_collisions"))
    way = [column(rows, "dt_mean_m") for rows in (now, then)]
    hard = [float(np.mean(column(rows, "hard_brakings_av"))) for rows in (now, then)]
    *begun, both = errors_begun(zip(now, then, strict=True))
    return [
        *(world or "together", DEMAND.get(world, ""), str(len(keys)), label(policy), label(beside)),
        *in_collisions(now, then),
        _counted(caused, len(keys)),
        *(f"{np.mean(way[0]):.0f}", statistics.paired_mean(way[1], way[0]).text(0)),
        *(f"{hard[0]:.1f}", f"{hard[1]:.1f}"),
        f"{100 * both / max(sum(begun) - both, 1):.0f} %",
    ]


def in_collisions(now: Sequence[Row], then: Sequence[Row]) -> list[str]:
    """Cells of paired rows: episodes with an AV in a collision, those of `then`, the difference, p."""
    hit, before = (np.array([(row["av_involved_collisions"] or 0) > 0 for row in r]) for r in (now, then))
    return [
        *(_counted(int(side.sum()), len(side)) for side in (hit, before)),
        statistics.paired_share(before, hit).text(1, 100.0),
        f"{statistics.mcnemar(*statistics.discordant(before, hit)):.2g}",
    ]


def _counted(hits: int, count: int) -> str:
    return f"{hits}: {statistics.share(hits, count).text(1, 100.0)} %"


def drive(policy: str, demand: str, seeds: range, runs: Path, workers: str) -> None:
    """These episodes in all worlds of this demand; a run folder of their own, which is gone on with."""
    worlds = [word for name, d in DEMAND.items() if d == demand for word in ("--scenario", name)]
    which = ["--demand", demand, "--policy", policy, "--preset", Preset.LAWFUL, "--errors", LEVEL]
    folder = runs / f"{demand}-{label(policy)}-{seeds.start}"
    running = ["--seeds", f"{seeds.start}:{seeds.stop}", "--no-report", "--workers", workers]
    code = cosim(["evaluate", *worlds, *which, *running, "--resume", "--out", str(folder)])
    if code:
        raise SystemExit(code)


def paired(policies: Sequence[str], episodes: int, runs: Path, workers: str) -> list[str]:
    """Drive what is missing, block by block; a line a world and policy, and one of all together."""
    for first in range(FIRST_TEST_SEED, FIRST_TEST_SEED + episodes, BLOCK):
        seeds = range(first, first + BLOCK)
        for policy in (IDM, *policies):
            held = rows_of(runs, policy)
            for demand in dict.fromkeys(DEMAND.values()):
                worlds = [world for world, d in DEMAND.items() if d == demand]
                if any((world, seed) not in held for world in worlds for seed in seeds):
                    drive(policy, demand, seeds, runs, workers)
    rows = {name: rows_of(runs, name) for name in (IDM, *policies)}
    lines = [markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))]
    beside = [(policy, IDM) for policy in policies]
    beside += [(policy, CAR) for policy in policies if CAR in policies and policy != CAR]
    return [*lines, *(markdown_row(line(w, *pair, rows)) for pair in beside for w in (*DEMAND, ""))]


def main() -> None:
    """Make the page's table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=400, help="a world")
    parser.add_argument("--policy", nargs="+", default=["vfn-p", CAR])
    parser.add_argument("--runs", type=Path, default=Path("runs/humans"), help="where episodes are kept")
    parser.add_argument("--workers", default="2")
    parser.add_argument("--page", type=Path, default=PAGE)
    args = parser.parse_args()
    lines = paired(args.policy, args.episodes, args.runs, args.workers)
    fill(args.page, "paired", lines)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
