"""`cosim evaluate`: drive a whole matrix of episodes, resumable, on any number of worker processes."""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.cli import arguments
from cosim.errors import BadInput

if TYPE_CHECKING:
    from cosim.batch.matrix import Plan
    from cosim.batch.store import Store
    from cosim.scenario.options import EpisodeOptions
    from cosim.workers.engines import Engine
    from cosim.workers.tasks import Outcome

MAX_LISTED = 200  # cells listed by a dry run


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    evaluate = commands.add_parser(
        "evaluate",
        help="drive a matrix of scenarios, demands, policies and seeds",
        description="Drive every combination of what the flags or SPEC.yaml name, once per seed. A flag that "
        "is given beside SPEC.yaml replaces that line of it.",
    )
    add_matrix(evaluate)
    arguments.add(evaluate, "--seeds", help="seeds A, A+1, ... B-1 (default 200000:200001)")
    running = add_work(evaluate)
    running.add_argument("--no-report", action="store_true", help="leave report.html out")
    running.add_argument("--dry-run", action="store_true", help="print the matrix and an estimated time")
    arguments.add(running, "--json")
    evaluate.set_defaults(work=work)


def add_matrix(command: argparse.ArgumentParser, errors: str = "none") -> None:
    """The flags of the matrix, except seeds. `errors`: the default of that flag."""
    command.add_argument("spec", nargs="?", metavar="SPEC.yaml", help="the matrix, by the flags' names")
    axes = command.add_argument_group("the matrix (flags of SPEC.yaml's lists may be repeated)")
    arguments.options(
        axes,
        matrix=True,
        scenario="a scenario, its folder, a .sumocfg, or a glob",
        demand="a name, or a file or glob (.rou.xml, .trips.xml, flows, .gz); A,B is one demand of two files",
        errors="of human drivers: none, field, stress, or a file (docs/explanation/driver_errors.md) "
        f"(default: {errors})",
    )


def add_work(command: argparse.ArgumentParser) -> Any:
    """The flags of the execution; returns their group."""
    running = command.add_argument_group("the work")
    arguments.add(running, "--out", "--resume")
    arguments.add(running, "--workers", help="processes (default: all cores)")
    running.add_argument("--engine", choices=("local", "ray"), default="local")
    running.add_argument("--ray-address", metavar="A", help="an existing cluster (default: a local one)")
    running.add_argument("--store", metavar="URL", help="a database instead of DIR/store.sqlite")
    running.add_argument("--step-timeout", type=arguments.positive, metavar="S", help="end a hung decision")
    running.add_argument("--reset-timeout", type=arguments.positive, metavar="S", help="end a hung start")
    return running


def work(args: argparse.Namespace) -> int:
    """0 when every episode has a row of any status.

    Raises BadInput before the first episode, or CosimError when the run cannot continue.
    """
    from cosim.batch import execution, matrix
    from cosim.policies import check
    from cosim.scenario.vet import watched
    from cosim.workers.progress import Progress

    if args.out is None and (continued(args) or not args.dry_run):
        raise BadInput("name the run's folder", field="--out")
    named = functools.partial(check, field="policy", file=args.spec) if _in_spec(args) else check
    with Progress("evaluate: checking files", "MB") as checking, watched(checking):
        plan = matrix.plan(*asked(args), named)
    if not args.resume:
        matrix.check_names(plan)
    engine = engine_of(args)
    if args.dry_run:
        return _dry_run(plan, engine, args)
    with opened(plan, args, execution.begin_or_resume) as (store, folder):
        return _drive(plan, engine, store, folder, args)


def _in_spec(args: argparse.Namespace) -> bool:
    """Whether the policies are those of a spec, not of the command line."""
    return args.spec is not None and not args.policy


def continued(args: argparse.Namespace) -> bool:
    """Whether to continue a run with its folder's plan: without a spec or a flag of the matrix."""
    from cosim.batch import spec

    return bool(args.resume) and args.spec is None and all(getattr(args, n) is None for n in spec.FIELDS)


def asked(args: argparse.Namespace) -> tuple[list[EpisodeOptions], range]:
    """The case of every cell, and the seeds. Raises BadInput."""
    from cosim.batch import execution, matrix, spec

    if continued(args):
        return execution.asked(Path(args.out), args.store)
    flags = {name: getattr(args, name) for name in spec.FIELDS}
    wanted = spec.read(None if args.spec is None else Path(args.spec), flags)
    return [*matrix.cells(wanted)], range(*wanted.seeds)


@contextlib.contextmanager
def opened(plan: Plan, args: argparse.Namespace, begin: Callable[..., None]) -> Iterator[tuple[Store, Path]]:
    """The store and the folder of a run, begun with this plan or resumed; removed again on failure."""
    from cosim.batch.folder import RunFolder
    from cosim.batch.store import Store

    with RunFolder(args.out, resume=args.resume, episodes=plan.episodes) as folder:
        try:
            store = Store.in_folder(folder.path, args.store)
            began = time.strftime("%Y-%m-%dT%H:%M:%S%z")
            about = {"command": shlex.join(["cosim", *sys.argv[1:]]), "began": began}
            begin(plan, store, about, resume=args.resume)
        except BaseException:
            if not args.resume:
                folder.undo()
            raise
        with store:
            yield store, folder.path


def engine_of(args: argparse.Namespace) -> Engine:
    """The engine that distributes the episodes over processes or machines."""
    from cosim.batch.episode_runner import EpisodeRunner
    from cosim.workers.engines import LocalEngine
    from cosim.workers.supervisor import Limits

    default = Limits()
    limits = Limits(step=args.step_timeout or default.step, start=args.reset_timeout or default.start)
    if args.engine == "local":
        if args.ray_address is not None:
            raise BadInput("goes with --engine ray", field="--ray-address", value=args.ray_address)
        return LocalEngine(EpisodeRunner, workers=args.workers, limits=limits)
    from cosim.workers.ray_engine import RayEngine

    return RayEngine(EpisodeRunner, workers=args.workers, limits=limits, address=args.ray_address)


def _drive(plan: Plan, engine: Engine, store: Store, folder: Path, args: argparse.Namespace) -> int:
    found = driven("evaluate", plan, engine, store, folder)
    report = None
    if not args.no_report:
        from cosim.report import html, run_folder  # matplotlib: a second that only a report need pay

        report = html.write(run_folder.read(folder), None, shown=args.out)
    found.warn()
    if args.json:
        print(json.dumps(found.summary))
    else:
        print(found.text(plan, folder))
        if report is not None:
            print(f"  report     {report}")
    return found.exit_code


@dataclass(frozen=True)
class Driven:
    """The result of a plan."""

    rows: Sequence[Mapping[str, Any]]
    summary: Mapping[str, Any]
    faults: Sequence[Outcome]  # internal errors, without a row
    done: int  # episodes finished earlier
    seconds: float

    @property
    def exit_code(self) -> int:
        """0 when every episode has its row, else 4."""
        return 4 if self.faults else 0

    def warn(self) -> None:
        """Say on stderr which episodes have no figures or no row."""
        _warn(self.rows)
        for fault in self.faults:
            print(f"cosim: {fault.key}: no row, --resume tries it again: {fault.stderr}", file=sys.stderr)

    def text(self, plan: Plan, folder: Path) -> str:
        """Numbers of episodes, rate and statuses."""
        from cosim.report.summary import not_comparable, reasons
        from cosim.report.wording import counted

        now = plan.episodes - self.done
        unfit = reasons([row for row in self.rows if not_comparable(row)])
        status = {**self.summary["status"], "not driven": plan.episodes - len(self.rows)}
        return (
            f"{counted(plan.episodes, 'episode')} of {counted(len(plan.cells), 'cell')} in {folder}\n"
            f"  driven now {now} in {self.seconds:.1f} s ({now / max(self.seconds, 1e-9):.2f} episodes/s)\n"
            "  status     "
            + ", ".join(f"{name} {n}" for name, n in status.items() if n)
            + "".join(f"\n  not comparable: {counted(n, 'episode')}: {why}" for why, n in unfit.items())
        )


def driven(name: str, plan: Plan, engine: Engine, store: Store, folder: Path) -> Driven:
    """Drive the missing episodes, with progress, and export all."""
    from cosim.batch import execution
    from cosim.report.run_folder import export
    from cosim.report.wording import counted
    from cosim.workers.progress import Progress

    done = len(store.keys())
    title = f"{name} ({done} of {plan.episodes} done before)" if done else name
    began = time.monotonic()
    with Progress(title, "episodes") as progress:
        progress.starting()
        try:
            faults = execution.drive(plan, store, engine, folder / "outputs", progress)
        except KeyboardInterrupt:
            kept = f"{len(store.keys())} of {counted(plan.episodes, 'episode')} are kept"
            print(f"cosim: {kept}: the same command with --resume goes on", file=sys.stderr)
            raise
    seconds = time.monotonic() - began
    rows = store.rows()
    summary = export(folder, rows, execution.manifest(plan, store), plan.episodes)
    return Driven(rows, summary, faults, done, seconds)


def _warn(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print episodes without figures and the reasons on stderr."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row["status"] != "ok":
            reasons.setdefault((row["status"], row["error"] or ""), []).append(row["key"])
    if reasons:
        wrong = sum(map(len, reasons.values()))
        print(f"cosim: {wrong} of {len(rows)} episodes have no figures:", file=sys.stderr)
    for (status, error), keys in [*reasons.items()][:10]:
        which = keys[0] if len(keys) == 1 else f"{keys[0]} and {len(keys) - 1} more"
        print(f"  {status}: {which}: {error[:500]}", file=sys.stderr)
    if len(reasons) > 10:
        print(f"  and {len(reasons) - 10} further reasons: see the column `error`", file=sys.stderr)


def _dry_run(plan: Plan, engine: Engine, args: argparse.Namespace) -> int:
    from cosim.batch.estimate import estimate
    from cosim.workers.engines import cores

    seconds, basis = estimate(plan, engine, args.workers or cores())
    if args.json:
        document = {
            "episodes": plan.episodes,
            "seeds": [plan.seeds.start, plan.seeds.stop],
            "cells": [
                {"cell": cell.name, "case": cell.case.document(), "refused": cell.refused}
                for cell in plan.cells
            ],
            "estimated_s": seconds,
            "estimated_from": basis,
        }
        print(json.dumps(document))
        return 0
    for cell in plan.cells[:MAX_LISTED]:
        s, case = cell.scenario, cell.case
        print(
            f"{cell.name}  {s.name} / {s.demand_name} / {case.policy}, {s.behavior}, "
            f"AVs by {s.fleet.describe()}, svo {case.svo_deg:g}, {s.preset}, {s.driver_model}, "
            f"{s.duration:g} s" + (f"  BAD INPUT: {cell.refused}" if cell.refused else "")
        )
    if len(plan.cells) > MAX_LISTED:
        print(f"... and {len(plan.cells) - MAX_LISTED} more")
    span = f"{plan.seeds.start}:{plan.seeds.stop}"
    print(f"{len(plan.cells)} cells x {len(plan.seeds)} seeds ({span}) = {plan.episodes} episodes")
    print(f"estimated time {'unknown' if seconds is None else _duration(seconds)} ({basis})")
    return 0


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
