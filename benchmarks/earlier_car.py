"""Whether the lawful car crashes more than an earlier one, of a commit of this repository.

    python -m benchmarks.earlier_car [--commit d1dd159] [--seeds A:B] [--scenario NAME ...] [--duration S]
                                     [--workers N] [--again] [--out docs/results]

Drives both cars alone (the agent always asks for more speed) on today's full roads, on equal seeds, with the
driver errors `stress`. The earlier car is driven by its own source, with today's roads and demands. Needs a
clone with its history. Rows are kept in docs/results/data/earlier_car.csv; the page is made from them.
"""

from __future__ import annotations

import argparse
import io
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from benchmarks import drives
from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.cli.arguments import seeds as seed_range
from cosim.report.statistics import paired_change, paired_rate_change, pooled_rate
from sumo_scenarios.roads import NAMED

HOME = Path(__file__).parents[1]
RESULTS = Path("docs/results")
PAGE, DATA = "earlier_car.md", "data/earlier_car.csv"
COMMIT = "d1dd159"  # the last one before the car was rebuilt
FIRST, SEEDS = 300_000, 10
EARLIER, TODAY = CARS = ("earlier", "today")
PER = 1000.0  # AV-km, in which collisions are counted


class Drive(NamedTuple):
    """A row of the CSV."""

    car: str
    road: str
    seed: int
    total_delay_s: float
    av_involved_collisions: float
    av_caused_collisions: float
    av_km: float


KEY = 3  # columns that name the episode


def source(commit: str, folder: Path) -> None:
    """Put a commit's files into the folder, with today's roads. Raises SystemExit for an unknown commit."""
    found = subprocess.run(["git", "-C", str(HOME), "archive", commit], capture_output=True, check=False)
    if found.returncode != 0:
        raise SystemExit(f"error: --commit={commit!r}: {found.stderr.decode().strip()}")
    with tarfile.open(fileobj=io.BytesIO(found.stdout)) as files:
        files.extractall(folder, filter="data")
    shutil.copytree(HOME / "sumo_scenarios/open", folder / "sumo_scenarios/open", dirs_exist_ok=True)


def case(key: tuple[str, str, int], code: Path | None, duration: float | None) -> drives.Case:
    """The episode of a car on a road with a seed, driven by other source code if any."""
    _, road, seed = key
    options: dict[str, Any] = {
        **{"what": f"open/{road}", "demand": "over", "policy": "car-alone", "svo_deg": 45.0},
        **{"penetration": 0.2, "behavior": "moderate", "errors": "stress", "seed": seed},
        **({} if duration is None else {"duration": duration}),
    }
    return drives.Case(key, options, code=code)


def page(rows: Sequence[Drive], commit: str) -> list[str]:
    """The page."""
    columns = ["road", "seeds", "AV-km", "earlier", "today", "change", "caused by AVs", "delay, s", "change"]
    lines = markdown_head(columns)
    lines += [markdown_row(cells) for cells in _table(rows)]
    first = min(row.seed for row in rows)
    return WORDS.format(table="\n".join(lines), commit=commit, first=first, data=DATA).splitlines()


def _table(rows: Sequence[Drive]) -> Iterator[list[str]]:
    """The cells of every road, then of all."""
    of = {row[:KEY]: row for row in rows}
    pairs = [
        (row, of[TODAY, *row[1:KEY]]) for row in rows if row.car == EARLIER and (TODAY, *row[1:KEY]) in of
    ]
    for road in (*dict.fromkeys(before.road for before, _ in pairs), ""):
        chosen = [pair for pair in pairs if road in (pair[0].road, "")]
        if chosen:
            yield [f"`{road}`" if road else "all", *_cells(*zip(*chosen, strict=True))]


def _cells(before: Sequence[Drive], after: Sequence[Drive]) -> list[str]:
    tallies = [
        np.array([[one.av_involved_collisions for one in of], [one.av_km / PER for one in of]])
        for of in (before, after)
    ]
    rates = [pooled_rate(*tally).text(0) for tally in tallies]
    change = paired_rate_change(*tallies).text(0, 100.0)
    caused = ", ".join(f"{sum(one.av_caused_collisions for one in of):.0f}" for of in (before, after))
    delay_before, delay_after = ([one.total_delay_s for one in of] for of in (before, after))
    delay = f"{fmean(delay_before):.0f}, {fmean(delay_after):.0f}"
    km = f"{sum(one.av_km for one in after):,.0f}"
    found = paired_change(delay_before, delay_after).text(0, 100.0)
    return [str(len(after)), km, *rates, f"{change} %", caused, delay, f"{found} %"]


WORDS = """# Does the lawful car crash more than the one before it?

The car was rebuilt to choke full roads less: a shorter headway, courtesy, early braking. Here both
drive the same traffic, with the driver errors `stress`. Collisions are those with an AV in 1,000
AV-km; pairs of figures are the earlier car's and today's. Brackets hold 95 % intervals.

{table}

## Conditions

The six open roads at demand `over`, seeds from {first:,}. 20 % AVs that always ask for more speed,
phi 45, drivers `moderate`, sensing `ideal`. The earlier car is that of commit `{commit}`, driven by
its own source on today's roads. Rows: [{data}]({data}).

```
python -m benchmarks.earlier_car
```
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive the missing episodes, then write rows and page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--commit", default=COMMIT, metavar="ID")
    parser.add_argument("--seeds", type=seed_range, default=f"{FIRST}:{FIRST + SEEDS}", metavar="A:B")
    parser.add_argument("--scenario", nargs="+", default=[*NAMED], choices=[*NAMED], metavar="NAME")
    parser.add_argument("--duration", type=float, metavar="S", help="of each drive; needs its own --out")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--again", action="store_true", help="drive the kept episodes again")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FOLDER")
    args = parser.parse_args(arguments)
    wanted = [(car, road, seed) for seed in args.seeds for road in args.scenario for car in CARS]
    with tempfile.TemporaryDirectory() as folder:
        source(args.commit, Path(folder))
        code = {EARLIER: Path(folder), TODAY: None}
        cases = [case(key, code[key[0]], args.duration) for key in wanted]
        try:
            rows = drives.measure(Drive, cases, args.workers, args.out / DATA, args.again)
        except ChildProcessError as error:
            raise SystemExit(f"error: {error}") from None
    write_page(args.out / PAGE, page(rows, args.commit))
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
