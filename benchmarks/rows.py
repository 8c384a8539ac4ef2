"""The episodes behind the pages of `vfn-p`: kept with their trace hashes, some of them driven anew on demand.

    python -m benchmarks.rows keep PAGE RUN [RUN ...]     # run folders -> docs/results/data/rows/PAGE.csv.gz
    python -m benchmarks.rows keep PAGE RUN [RUN ...] --add     # to the rows that are there
    python -m benchmarks.rows check [PAGE ...] [--sample 10]

`check` drives episodes picked at random and compares every figure that is kept and the trace hash; it ends
with exit code 1 when one differs, as those of networks that no longer ship do.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import io
import random
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from benchmarks.forced_entry import forced
from cosim.cli.main import main as cosim
from cosim.errors import BadInput, CosimError
from cosim.files import whole
from cosim.report import run_folder
from cosim.scenario import load
from cosim.workers.tasks import OK

KEPT = Path("docs/results/data/rows")
IDENTITY = ("policy", "scenario", "demand", "behavior", "driver_model", "preset", "errors", "svo_deg", "seed")
FIGURES = (
    *("steps", "crashed", "collisions", "av_involved_collisions", "av_caused_collisions"),
    *("hv_hv_collisions", "mission_success", "mission_time_s", "dt_mean_m", "dt_av_m", "dt_hv_m"),
    *(
        "dt_mission_m",
        "hard_brakings_av",
        "av_near_misses_ttc",
        "interventions",
        "human_errors",
        "trace_hash",
    ),
)
COLUMNS = (*IDENTITY, *FIGURES)
FORCED = "forced_"  # a level of `benchmarks.forced_entry`: its lag follows

Kept = dict[str, str]  # column -> text


def kept(row: Mapping[str, Any]) -> Kept:
    """One row as the file holds it."""
    return {name: "" if row.get(name) is None else str(row[name]) for name in COLUMNS}


def keep(page: str, runs: Sequence[Path], out: Path = KEPT, *, add: bool = False) -> int:
    """Write the rows of these run folders, sorted; the same rows give the same file. Returns how many.

    `add`: beside the rows that are there; of one episode the newer row. Raises BadInput for a folder that is
    none, or where there are no rows to add to.
    """
    rows = [kept(row) for run in runs for row in run_folder.read(run).rows if row["status"] == OK]
    if add:
        newest = {tuple(row[name] for name in IDENTITY): row for row in (*read(page, out), *rows)}
        rows = list(newest.values())
    rows.sort(key=lambda row: (*(row[name] for name in IDENTITY[:-1]), int(row["seed"])))
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    out.mkdir(parents=True, exist_ok=True)
    with whole(out / f"{page}.csv.gz") as draft:
        draft.write_bytes(gzip.compress(text.getvalue().encode(), mtime=0))
    return len(rows)


def read(page: str, out: Path = KEPT) -> list[Kept]:
    """The rows of a page. Raises BadInput where there are none."""
    file = out / f"{page}.csv.gz"
    if not file.is_file():
        there = ", ".join(sorted(path.name.removesuffix(".csv.gz") for path in out.glob("*.csv.gz")))
        raise BadInput(f"no rows are kept of this page; there are: {there}", field="PAGE", value=page)
    return list(csv.DictReader(gzip.decompress(file.read_bytes()).decode().splitlines()))


def words(row: Kept, folder: Path) -> list[str]:
    """The words after `cosim evaluate` that drive this row."""
    policy, errors = row["policy"], row["errors"]
    found = ["--scenario", row["scenario"], "--demand", row["demand"], "--preset", row["preset"]]
    found += ["--policy", policy]
    found += ["--svo", row["svo_deg"], "--seeds", f"{row['seed']}:{int(row['seed']) + 1}"]
    if load(row["scenario"], demand=[row["demand"]]).behavior != row["behavior"]:
        found += ["--behavior", row["behavior"]]
    if errors.startswith(FORCED):
        errors = forced(float(errors.removeprefix(FORCED).partition("-")[0]), folder)
    return found + (["--errors", errors] if errors else [])


def differing(row: Kept) -> Iterator[str]:
    """Drives one row anew: a line for every column that is another now."""
    what = " ".join(row[name] for name in IDENTITY if row[name])
    with tempfile.TemporaryDirectory(prefix="cosim-rows-") as name:
        out = Path(name, "run")
        asked = [*words(row, Path(name)), "--no-report", "--workers", "1", "--out", str(out)]
        with redirect_stdout(io.StringIO()):
            code = cosim(["evaluate", *asked])
        found = [kept(one) for one in run_folder.read(out).rows] if not code else []
    if not found:
        yield f"{what}: was not driven (exit code {code})"
        return
    for column in COLUMNS:
        if found[0][column] != row[column]:
            yield f"{what}: {column} was {row[column] or 'none'}, is {found[0][column] or 'none'}"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    keeping = commands.add_parser("keep")
    keeping.add_argument("page", metavar="PAGE")
    keeping.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    keeping.add_argument("--add", action="store_true", help="to the rows that are there")
    checking = commands.add_parser("check")
    checking.add_argument("pages", nargs="*", metavar="PAGE", help="default: all")
    checking.add_argument("--sample", type=int, default=10, metavar="N", help="episodes")
    checking.add_argument("--seed", type=int, default=0, help="of the pick")
    args = parser.parse_args()
    try:
        if args.command == "keep":
            print(f"{KEPT / args.page}.csv.gz: {keep(args.page, args.runs, add=args.add)} episodes")
            return
        pages = args.pages or sorted(path.name.removesuffix(".csv.gz") for path in KEPT.glob("*.csv.gz"))
        rows = [row for page in pages for row in read(page)]
        picked = random.Random(args.seed).sample(rows, min(args.sample, len(rows)))
        lines = [line for row in picked for line in differing(row)]
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(*lines, f"{len(picked)} of {len(rows)} episodes driven anew, {len(lines)} differences", sep="\n")
    raise SystemExit(1 if lines else 0)


if __name__ == "__main__":
    main()
