"""What `cosim evaluate` does: everything checked first, then every episode driven and kept, then exported."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.batch import execution as batch
from cosim.batch import matrix
from cosim.batch import spec as specs
from cosim.batch.case_runner import CaseRunner
from cosim.batch.estimate import estimate
from cosim.batch.export import export
from cosim.batch.folder import RunFolder
from cosim.batch.store import FILE, Store
from cosim.errors import BadInput
from cosim.policies import check
from cosim.report.summary import summarize
from cosim.scenario.episode_id import Case
from cosim.workers.engines import Engine, LocalEngine, cores
from cosim.workers.progress import Progress
from cosim.workers.supervisor import Limits

LINES = 200  # cells that a dry run lists


def evaluate(args: argparse.Namespace) -> int:
    """The whole verb. Raises BadInput before anything is run, or CosimError when it cannot go on."""
    plan = _plan(args)
    engine = _engine(args)
    if args.dry_run:
        return _dry_run(plan, engine, args)
    if args.out is None:
        raise BadInput("name the run's folder", field="--out")
    with RunFolder(args.out, resume=args.resume, episodes=plan.episodes) as folder:
        store = _store(folder, plan, args)
        with store:
            return _drive(plan, engine, store, folder.path, args)


def _plan(args: argparse.Namespace) -> matrix.Plan:
    """From the spec and the flags; with --resume and neither, from what the folder holds."""
    flags = {name: getattr(args, name) for name in specs.FIELDS}
    if args.resume and args.spec is None and all(value is None for value in flags.values()):
        return _plan_of(args)
    spec = specs.read(None if args.spec is None else Path(args.spec), flags)
    return matrix.plan(matrix.cells(spec), range(*spec.seeds), check)


def _plan_of(args: argparse.Namespace) -> matrix.Plan:
    if args.out is None:
        raise BadInput("name the run's folder", field="--out")
    folder = Path(args.out)
    if args.store is None and not (folder / FILE).is_file():
        raise BadInput("holds no run to resume", field="--out", value=args.out)
    with _open_store(folder, args) as store:
        if store.spec_hash() is None:
            raise BadInput("holds no run to resume", field="--out", value=args.out)
        cases = [Case.read(cell["case"]) for cell in store.cells().values()]
        return matrix.plan(cases, range(*store.document()["seeds"]), check)


def _engine(args: argparse.Namespace) -> Engine:
    default = Limits()
    limits = Limits(step=args.step_timeout or default.step, start=args.reset_timeout or default.start)
    if args.engine == "local":
        if args.ray_address is not None:
            raise BadInput("goes with --engine ray", field="--ray-address", value=args.ray_address)
        return LocalEngine(CaseRunner, workers=args.workers, limits=limits)
    from cosim.workers.ray_engine import RayEngine

    return RayEngine(CaseRunner, workers=args.workers, limits=limits, address=args.ray_address)


def _open_store(folder: Path, args: argparse.Namespace) -> Store:
    """A database given by URL may hold many runs: this one goes by its folder's name."""
    return Store.in_folder(folder) if args.store is None else Store(args.store, folder.absolute().name)


def _store(folder: RunFolder, plan: matrix.Plan, args: argparse.Namespace) -> Store:
    """The store, begun with this plan or found to be of this plan."""
    begun = False
    try:
        store = _open_store(folder.path, args)
        begun = store.spec_hash() is not None
        if begun and not args.resume:
            problem = f"holds a run named {folder.path.name} already: --resume it, or name another --out"
            raise BadInput(problem, field="--store")
        if begun:
            batch.check_same(plan, store)
        else:
            command = shlex.join(["cosim", *sys.argv[1:]])
            batch.begin(plan, store, {"command": command, "began": time.strftime("%Y-%m-%dT%H:%M:%S%z")})
        return store
    except BaseException:
        if not begun and not args.resume:
            folder.undo()
        raise


def _drive(plan: matrix.Plan, engine: Engine, store: Store, folder: Path, args: argparse.Namespace) -> int:
    done = len(store.keys())
    title = f"evaluate ({done} of {plan.episodes} done before)" if done else "evaluate"
    began = time.monotonic()
    with Progress(title, "episodes") as progress:
        faults = batch.drive(plan, store, engine, folder / "outputs", progress)
    seconds = time.monotonic() - began
    rows = store.rows()
    manifest = _manifest(plan, store)
    summary = {"planned": plan.episodes} | summarize(rows, manifest["units"], manifest["better"])
    export(folder, rows, manifest, summary)
    if not args.no_report:
        from cosim.report import (
            html as report,  # matplotlib: a second that a run without a report need not pay
        )
        from cosim.report.run_folder import read

        report.write(read(folder), None, shown=args.out)
    _warn(rows)
    for fault in faults:
        print(f"cosim: {fault.key}: no row, --resume tries it again: {fault.stderr}", file=sys.stderr)
    if args.json:
        print(json.dumps(summary))
    else:
        driven = plan.episodes - done
        print(f"{plan.episodes} episodes of {len(plan.cells)} cells in {folder}")
        print(f"  driven now {driven} in {seconds:.1f} s ({driven / max(seconds, 1e-9):.2f} episodes/s)")
        status = {**summary["status"], "not driven": plan.episodes - len(rows)}
        print("  status     " + ", ".join(f"{name} {n}" for name, n in status.items() if n))
    return 4 if faults else 0


def _manifest(plan: matrix.Plan, store: Store) -> dict[str, Any]:
    """manifest.json: what was run, on what; per cell what `cosim.scenario.manifest` says of all."""
    cells = store.cells()
    versions: dict[str, Any] = next((cell["manifest"]["versions"] for cell in cells.values()), {})
    return {
        **store.document(),
        "spec": plan.spec_hash,
        "versions": versions,
        "cells": cells,
    }


def _warn(rows: Sequence[Mapping[str, Any]]) -> None:
    """Say on stderr which episodes have no figures, and why."""
    wrong = [row for row in rows if row["status"] != "ok"]
    reasons: dict[tuple[str, str], list[str]] = {}
    for row in wrong:
        reasons.setdefault((row["status"], row["error"] or ""), []).append(row["key"])
    if wrong:
        print(f"cosim: {len(wrong)} of {len(rows)} episodes have no figures:", file=sys.stderr)
    for (status, error), keys in [*reasons.items()][:10]:
        which = keys[0] if len(keys) == 1 else f"{keys[0]} and {len(keys) - 1} more"
        print(f"  {status}: {which}: {error[:500]}", file=sys.stderr)
    if len(reasons) > 10:
        print(f"  and {len(reasons) - 10} further reasons: see the column `error`", file=sys.stderr)


def _dry_run(plan: matrix.Plan, engine: Engine, args: argparse.Namespace) -> int:
    workers = args.workers or cores()
    found = estimate(plan, engine, workers)
    if args.json:
        cells = [
            {"cell": cell.name, "case": cell.case.document(), "refused": cell.refused} for cell in plan.cells
        ]
        document = {
            "episodes": plan.episodes,
            "seeds": [plan.seeds.start, plan.seeds.stop],
            "cells": cells,
            "estimated_s": found.seconds,
            "estimated_from": found.basis,
        }
        print(json.dumps(document))
        return 0
    for cell in plan.cells[:LINES]:
        s, case = cell.scenario, cell.case
        fleet = s.fleet.describe()
        line = f"{cell.name}  {s.name} / {s.demand_name} / {case.policy}, {s.behavior}, AVs by {fleet}, "
        line += f"svo {case.svo_deg:g}, {s.preset}, {s.driver_model}, {s.duration:g} s"
        print(line + (f"  BAD INPUT: {cell.refused}" if cell.refused else ""))
    if len(plan.cells) > LINES:
        print(f"... and {len(plan.cells) - LINES} more")
    seeds = f"{plan.seeds.start}:{plan.seeds.stop}"
    print(f"{len(plan.cells)} cells x {len(plan.seeds)} seeds ({seeds}) = {plan.episodes} episodes")
    time_ = "unknown" if found.seconds is None else _duration(found.seconds)
    print(f"estimated time {time_} ({found.basis})")
    return 0


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
