"""`python -m research`: lists claims, drives their episodes, writes, checks and audits their pages."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import sumo_scenarios
from cosim.batch import spec
from cosim.errors import BadInput, CosimError
from research import audit, drive, evaluate, index, kept, page, schema
from research.drive import Settings
from research.schema import Claim

SAMPLE = 20  # episodes of `audit`
STALE, INTERRUPTED = 1, 130  # exit codes


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code: 0; 1 a page is stale or an episode differs; 2 a claim is invalid; 130 interrupted."""
    args = _parser().parse_args(arguments)
    try:
        claims = [*schema.chosen(args.names, args.claims)]
        work: Callable[[list[Claim], Settings, argparse.Namespace], int] = args.work
        return work(claims, settings_of(args), args)
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("interrupted: the same command continues", file=sys.stderr)
        return INTERRUPTED


def _list(claims: list[Claim], settings: Settings, args: argparse.Namespace) -> int:
    """A line for every claim: episodes driven and wanted, and the CPU hours left."""
    found = drive.held(claims, settings)
    for claim in claims:
        arms = found.arms[claim.name].values()
        wanted, there = sum(len(arm.seeds) for arm in arms), sum(len(arm.rows) for arm in arms)
        times = [row["total_s"] for arm in arms for row in arm.rows if row.get("total_s")]
        left = (wanted - there) * sum(times) / len(times) / 3600.0 if times else None
        cost = "" if left is None else f", {left:.1f} CPU hours left"
        print(f"{claim.name:14} {there:6} of {wanted:6} episodes{cost}  {index.answer(claim, args.out)}")
    return 0


def _drive(claims: list[Claim], settings: Settings, _: argparse.Namespace) -> int:
    """Drive the missing episodes."""
    found = drive.drive(claims, settings)
    incomplete = [c.name for c in claims if not all(a.complete for a in found.arms[c.name].values())]
    if incomplete:
        print(f"research: episodes are missing for {', '.join(incomplete)}", file=sys.stderr)
    return 0


def _page(claims: list[Claim], settings: Settings, args: argparse.Namespace) -> int:
    """Write the pages of the claims whose episodes are all there, and the index."""
    found = drive.held(claims, settings)
    for claim in claims:
        arms = found.arms[claim.name]
        missing = sum(len(arm.seeds) - len(arm.rows) for arm in arms.values())
        if missing or not arms:
            print(f"{claim.name}: page unchanged: {missing} episodes are missing", file=sys.stderr)
            continue
        print(page.write(evaluate.evaluate(claim, arms, found.notes), settings, args.out))
    print(index.write([*schema.chosen([], args.claims)], args.out))
    return 0


def _check(claims: list[Claim], settings: Settings, args: argparse.Namespace) -> int:
    """Check that every page was made with the present weights and definitions."""
    work = drive.planned(claims, settings)
    lines = [line for claim in claims for line in index.stale(claim, work, args.out)]
    print(*lines, f"{len(lines)} differences: `drive` and `page` update the pages" if lines else "", sep="\n")
    return STALE if lines else 0


def _keep(claims: list[Claim], settings: Settings, args: argparse.Namespace) -> int:
    """Keep the episodes of all claims in the repository."""
    part = args.names or settings.scenarios or (settings.scale, settings.seeds, settings.duration) != WHOLE
    if part and settings.kept in (None, kept.FOLDER):
        raise BadInput("would replace the kept episodes of all claims by a part: name another --kept folder")
    work = drive.planned(claims, settings)
    folder = settings.kept or kept.FOLDER
    with drive.opened(work, settings) as store:
        print(f"{kept.keep(store, work.wanted, folder)} episodes in {folder}")
    return 0


def _audit(claims: list[Claim], settings: Settings, args: argparse.Namespace) -> int:
    """Drive a sample of the kept episodes again; compare every figure and the trace hash."""
    found = audit.audit(drive.planned(claims, settings), settings, args.sample, args.pick)
    print(*found.differing, sep="\n", end="\n" if found.differing else "")
    wrong = len({line.split(":")[0] for line in found.differing})
    print(f"{found.driven - wrong} of {found.driven} driven again are equal in every figure and trace hash")
    print(f"{found.kept} are kept; with other weights, files or versions than here: {found.unknown}")
    return STALE if found.differing else 0


WHOLE = Settings().scale, Settings().seeds, Settings().duration
COMMANDS = {"list": _list, "drive": _drive, "page": _page, "check": _check, "keep": _keep, "audit": _audit}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Flags for amount, engine and folders of the drives."""
    add, default = parser.add_argument, Settings()
    add("--workers", type=int, default=default.workers, metavar="N")
    add("--engine", choices=("local", "ray"), default=default.engine)
    add("--scale", type=float, default=default.scale, metavar="X", help="factor on the number of episodes")
    add("--seeds", metavar="A:B", help="instead of every claim's own seeds")
    add("--scenario", action="append", default=[], choices=sumo_scenarios.shipped())
    add("--duration", type=float, metavar="S", help="episode duration (default: the scenario's)")
    add("--untrained", action="store_true", help="also drive networks with initial weights, labelled so")
    add("--runs", type=Path, default=default.runs, metavar="DIR", help="folder of driven episodes")
    add("--out", type=Path, default=page.OUT, metavar="DIR", help="folder of pages")
    add("--kept", type=Path, default=default.kept, metavar="DIR", help="folder of kept episodes")
    add("--anew", action="store_true", help="drive the kept episodes too")


def settings_of(args: argparse.Namespace) -> Settings:
    """The settings of the parsed flags. Raises BadInput for invalid seeds."""
    return Settings(
        runs=args.runs,
        workers=args.workers,
        engine=args.engine,
        kept=None if args.anew else args.kept,
        scale=args.scale,
        seeds=None if args.seeds is None else range(*spec.seeds(args.seeds, None, "--seeds")),
        scenarios=tuple(args.scenario),
        duration=args.duration,
        untrained=args.untrained,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m research", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="|".join(COMMANDS))
    for name, work in COMMANDS.items():
        command = commands.add_parser(name, help=work.__doc__, description=work.__doc__)
        command.set_defaults(work=work)
        command.add_argument("names", nargs="*", metavar="NAME", help="claims (default: all)")
        command.add_argument(
            "--claims", type=Path, default=schema.FOLDER, metavar="DIR", help="folder of claims"
        )
        add_flags(command)
        if work is _audit:
            about = f"number of episodes (default {SAMPLE})"
            command.add_argument("--sample", type=int, default=SAMPLE, metavar="N", help=about)
            command.add_argument("--pick", type=int, default=0, metavar="SEED", help="of the random sample")
    return parser
