"""Preset `lawful` against `unguarded` in our five worlds: crashes, hard brakings, distances.

    python -m benchmarks.lawful_worlds [--episodes 100] [--runs runs/lawful] [--workers 2] [--out PAGE]

`vfn-p-demonstrated` drives `dense` from test seed 200,000 on; the same command goes on where it stopped. The
episodes in `unguarded` ship (docs/results/episodes). Writes
docs/results/lawful_worlds.md.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import sumo_scenarios
from benchmarks.tables import markdown_row, write_page
from cosim.cli.main import main as cosim
from cosim.report import run_folder, statistics
from cosim.report.figures import Row
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import Preset
from cosim.workers.tasks import OK

PAGE = Path("docs/results/lawful_worlds.md")
SHIPPED = Path("docs/results/episodes")
FEWER, POLICY = 3.0, "vfn-p-demonstrated"  # how many times fewer hard brakings are asked for
COLUMNS = (
    "world", "episodes", "crashed", "hard brakings of AVs", "of it in unguarded", "distance of all, m",
    "less that in unguarded, m", "mission", "in unguarded", "interventions", "targets",
)  # fmt: skip


def by_seed(folder: Path, policy: str, preset: str) -> dict[str, dict[int, Row]]:
    """World -> seed -> the row of `dense` among mixed drivers."""
    found: dict[str, dict[int, Row]] = {}
    for row in run_folder.read(folder).rows:
        named = tuple(
            row[name] for name in ("policy", "preset", "demand", "behavior", "driver_model", "status")
        )
        if named == (policy, preset, "dense", "mixed", "lc2013", OK):
            found.setdefault(str(row["scenario"]), {})[int(row["seed"])] = row
    return found


def line(world: str, lawful: Mapping[int, Row], before: Mapping[int, Row]) -> list[str]:
    """One world's cells: paired by seed with `before`; crashes of both count."""
    seeds = sorted(lawful.keys() & before.keys())
    now, then = [lawful[s] for s in seeds], [before[s] for s in seeds]

    def column(rows: list[Row], name: str) -> list[float]:
        return [float(row[name]) for row in rows if row.get(name) is not None]

    crashed = statistics.share(sum(map(bool, column(now, "crashed"))), len(now))
    hard, hard_before = (float(np.mean(column(rows, "hard_brakings_av"))) for rows in (now, then))
    way = statistics.paired_mean(column(then, "dt_mean_m"), column(now, "dt_mean_m"))
    missions = [
        statistics.share(int(sum(v)), len(v)) for v in (column(r, "mission_success") for r in (now, then))
    ]
    missed = [
        name
        for name, wrong in (
            ("crashes", crashed.value > 0.0),
            ("hard brakings", hard * FEWER > hard_before),
            ("distance", way.high < 0.0),
        )
        if wrong
    ]
    return [
        *(world, str(len(seeds)), f"{crashed.text(1, 100.0)} %", f"{hard:.1f}", f"{hard_before:.1f}"),
        *(f"{np.mean(column(now, 'dt_mean_m')):.1f}", way.text(1)),
        *(f"{m.text(0, 100.0)} %" if m.known else "-" for m in missions),
        *(
            f"{np.mean(column(now, 'interventions')):.1f}",
            "missed: " + ", ".join(missed) if missed else "met",
        ),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--worlds", nargs="+", default=sumo_scenarios.names(), choices=sumo_scenarios.names())
    parser.add_argument("--runs", type=Path, default=Path("runs/lawful"), help="where episodes are kept")
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--workers", default="2")
    args = parser.parse_args()
    seeds = f"{FIRST_TEST_SEED}:{FIRST_TEST_SEED + args.episodes}"
    worlds = [word for name in args.worlds for word in ("--scenario", name)]
    which = ["--demand", "dense", "--policy", POLICY, "--preset", Preset.LAWFUL, "--seeds", seeds]
    running = ["--resume", "--workers", args.workers, "--out", str(args.runs)]
    code = cosim(["evaluate", *worlds, *which, *running])
    if code:
        raise SystemExit(code)
    lawful = by_seed(args.runs, POLICY, Preset.LAWFUL)
    before = by_seed(SHIPPED, POLICY, Preset.UNGUARDED)
    rows = [line(world, lawful[world], before[world]) for world in lawful]
    write_page(
        args.out,
        [
            "# Our worlds in preset `lawful`",
            "",
            f"`{POLICY}`, `dense`, mixed drivers (`lc2013`), seeds {seeds}; the same",
            "seeds in `unguarded` (shipped episodes). There AVs drive up to the limit + 2 m/s, in `lawful`",
            "up to the limit: where the road is free that alone is a shorter way. Targets: no crash, a third",
            "of the hard brakings at most, the distance of all not below (interval).",
            "",
            markdown_row(COLUMNS),
            markdown_row(["---"] * len(COLUMNS)),
            *map(markdown_row, rows),
            "",
            "Made by `python -m benchmarks.lawful_worlds`. Rates with Wilson, differences with bootstrap",
            "intervals (95 %).",
        ],
    )
    print(args.out.read_text())


if __name__ == "__main__":
    main()
