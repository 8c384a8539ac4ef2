"""The episodes that come with the repository: kept once they were driven, checked on demand.

    python -m benchmarks.papers.episodes keep                # what the pages need of runs/results
    python -m benchmarks.papers.episodes check --sample 20   # some of them driven anew: all the same?

`check` drives episodes picked at random and compares every figure and the trace hash; it ends with exit
code 1 when one differs.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.papers import shipped
from benchmarks.papers.agents import Agent, missing
from benchmarks.papers.driving import AgentRunner, Planned, Settings, agent_of, planned
from benchmarks.papers.jobs import JOBS
from benchmarks.papers.pages import Job
from cosim.batch.folder import RunFolder
from cosim.batch.matrix import Cell
from cosim.batch.records import row as row_of
from cosim.batch.store import FILE, Store
from cosim.errors import BadInput, CosimError
from cosim.report.figures import Row
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import Progress
from cosim.workers.tasks import OK

SAMPLE = 20  # episodes
DIFFERENT = 1  # exit code


@dataclass(frozen=True, slots=True)
class Checked:
    """What came of driving shipped episodes anew."""

    driven: int
    differing: tuple[str, ...]  # a line each: which episode, which column, what it was and is
    shipped: int
    unknown: int  # of those shipped: of other weights, files or versions than are here


def keep(settings: Settings, jobs: Sequence[Job] = JOBS) -> Counter[str]:
    """Ship what the store and the folder hold of the jobs' cells; demand/world/agent -> episodes.

    Episodes that failed are not shipped, and what no job orders any more is dropped.

    Raises BadInput: no store there, nothing to ship, or what is shipped was driven with other versions
    (nothing is written then).
    """
    if settings.shipped is None or not (settings.runs / FILE).is_file():
        raise BadInput("holds no episodes", field="--runs", value=str(settings.runs))
    work = _planned(jobs, settings)
    known = shipped.episodes(settings.shipped)
    versions = work.cells[0].manifest["versions"]
    if other := shipped.other_versions(versions, settings.shipped):
        problem = f"were driven with {other}: to keep others would drop them all (remove the folder first)"
        raise BadInput(problem, value=str(settings.shipped))
    cells: dict[str, Any] = dict(known.manifest.get("cells", {}))
    with RunFolder(str(settings.runs), resume=True, episodes=0), Store.in_folder(settings.runs) as store:
        rows = {row["key"]: row for row in (*known.rows, *store.rows())}
        cells |= store.cells()
        document = store.document()
    ordered = {cell.name for cell in work.cells}
    kept = [row for row in rows.values() if row["cell"] in ordered and row["status"] == OK]
    if not kept:
        raise BadInput("holds no episode that a page needs", field="--runs", value=str(settings.runs))
    present = {row["cell"] for row in kept}
    manifest = {
        "versions": versions,
        **{name: {**known.manifest.get(name, {}), **document[name]} for name in ("units", "better")},
        "cells": {
            cell.name: {"case": _case(cell, work.agents), "manifest": cells[cell.name]["manifest"]}
            for cell in work.cells
            if cell.name in present
        },
    }
    shipped.write(kept, manifest, settings.shipped)
    return Counter(f"{row['demand']}/{row['scenario']}/{row['policy']}" for row in kept)


def check(settings: Settings, sample: int, seed: int = 0, jobs: Sequence[Job] = JOBS) -> Checked:
    """Drive `sample` of the shipped episodes anew, picked by `seed`, and compare.

    Raises BadInput: nothing is shipped, or nothing of it is of this code's agents, files and versions.
    """
    rows = shipped.episodes(settings.shipped).rows
    if not rows:
        raise BadInput("holds no shipped episodes", value=str(settings.shipped))
    work = _planned(jobs, settings)
    mine = _known(rows, work)
    if not mine:
        other = shipped.other_versions(work.cells[0].manifest["versions"], settings.shipped)
        why = f"versions ({other})" if other else "weights or files"
        raise BadInput(f"were driven with other {why} than are here", value=str(settings.shipped))
    picked = random.Random(seed).sample(mine, min(sample, len(mine)))
    picked.sort(key=lambda row: row["key"])  # a cell's episodes one after the other
    anew = _drive(picked, work, settings)
    differing = tuple(line for row in picked for line in _differences(row, anew[row["key"]]))
    return Checked(len(picked), differing, len(rows), len(rows) - len(mine))


def unknown(settings: Settings, jobs: Sequence[Job] = JOBS) -> int:
    """How many shipped episodes are of other agents, weights, files or versions; none is driven."""
    rows = shipped.episodes(settings.shipped).rows
    return len(rows) - len(_known(rows, _planned(jobs, settings)))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.papers.episodes", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    default = Settings()
    commands = parser.add_subparsers(required=True, metavar="keep|check")
    keeping = commands.add_parser("keep", help="ship what the pages need of the episodes that were driven")
    keeping.add_argument("--runs", type=Path, default=default.runs, help="where the episodes are kept")
    keeping.set_defaults(work=_keep)
    checking = commands.add_parser("check", help="drive some of the shipped episodes anew and compare")
    checking.add_argument("--sample", type=int, default=SAMPLE, metavar="N", help=f"default {SAMPLE}")
    checking.add_argument("--seed", type=int, default=0, help="which ones; default 0")
    checking.add_argument("--workers", type=int, default=default.workers, metavar="N")
    checking.set_defaults(work=_check)
    for command in (keeping, checking):
        command.add_argument("--episodes", type=Path, default=shipped.FOLDER, help="the shipped ones' folder")
    args = parser.parse_args()
    try:
        raise SystemExit(args.work(args))
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None


# ---- inside ----


def _keep(args: argparse.Namespace) -> int:
    kept = keep(replace(Settings(), runs=args.runs, shipped=args.episodes))
    for name, episodes in kept.items():
        print(f"{episodes:6} {name}")
    size = (args.episodes / shipped.ROWS).stat().st_size
    print(f"{kept.total():6} episodes, {size / 1e6:.1f} MB in {args.episodes}")
    return 0


def _check(args: argparse.Namespace) -> int:
    found = check(replace(Settings(), workers=args.workers, shipped=args.episodes), args.sample, args.seed)
    for line in found.differing:
        print(line)
    wrong = len({line.split(":")[0] for line in found.differing})
    same = found.driven - wrong
    print(f"{same} of {found.driven} driven anew are the same in every figure and the trace hash")
    print(f"{found.shipped} are shipped; of other weights, files or versions than here: {found.unknown}")
    return DIFFERENT if found.differing else 0


def _planned(jobs: Sequence[Job], settings: Settings) -> Planned:
    """Every cell that the jobs order and whose agent can drive."""
    orders = [o for job in jobs for o in job.orders() if settings.untrained or missing(o.agent) is None]
    return planned(list(dict.fromkeys(orders)), settings)


def _known(rows: Sequence[Row], work: Planned) -> list[Row]:
    """Those of the cells that are planned here."""
    cells = {cell.name for cell in work.cells}
    return [row for row in rows if row["cell"] in cells]


def _case(cell: Cell, agents: Mapping[str, Agent]) -> dict[str, Any]:
    """What `cosim replay` is to drive: by the name `--policy` has for the agent, where it has one."""
    name = agent_of(cell.case.policy)
    return replace(cell.case, policy=name if agents[name] == Agent(name) else cell.case.policy).document()


def _drive(rows: Sequence[Row], work: Planned, settings: Settings) -> dict[str, dict[str, Any]]:
    """These episodes anew: key -> row."""
    cells = {cell.name: cell for cell in work.cells}
    cases = {row["key"]: cells[row["cell"]].case.with_seed(row["seed"]) for row in rows}
    tasks = [cells[case.cell].task(case) for case in cases.values()]
    engine = LocalEngine(AgentRunner, (work.agents, settings.untrained), workers=settings.workers)
    progress = Progress("check", "episodes")
    found = {}
    try:
        with closing(engine.run(tasks)) as outcomes:
            for outcome in outcomes:
                case = cases[outcome.key]
                found[outcome.key] = row_of(cells[case.cell], case, outcome)
                progress(len(found), len(tasks))
    finally:
        progress.done()
    return found


def _differences(row: Row, anew: Row) -> list[str]:
    """A line per column that is not the same."""
    if anew["status"] != OK:
        return [f"{row['key']}: {anew['status']}: {anew['error'] or anew['stderr']}"]
    episode = f"{row['key']}: {row['policy']} in {row['scenario']}, {row['demand']}, seed {row['seed']}"
    return [
        f"{episode}: {name} is {value}, shipped is {row.get(name)}"
        for name, value in shipped.plain(anew).items()
        if name in row and not _same(name, row[name], value)
    ]


def _same(name: str, before: Any, now: Any) -> bool:
    """Whether a column is what was shipped; of collisions, in all that was told of them then."""
    if name != "collision_list" or before == now or None in (before, now):
        return bool(before == now)
    then, today = json.loads(before), json.loads(now)
    return len(then) == len(today) and all(
        old == {key: new.get(key) for key in old} for old, new in zip(then, today, strict=True)
    )


if __name__ == "__main__":
    main()
