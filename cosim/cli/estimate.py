"""`cosim estimate`: crashes per million km at the given rates of driver errors, with an interval."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from cosim.cli import arguments, evaluate
from cosim.errors import BadInput
from cosim.scenario.options import EpisodeOptions

FIELD = "field"  # the default level of driver errors

EPILOG = """\
Most episodes are drawn with errors made more frequent (the tilt), and weigh less: docs/guides/estimate.md.
`cosim compare A B --fail-on 'crash_rate_per_million_km > 2'` reads the folder as one of `cosim evaluate`.
`--resume --out DIR --episodes N` lets a run go on to N episodes a cell.
"""


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    estimate = commands.add_parser(
        "estimate",
        help="estimate crashes per million km, by importance sampling",
        description="Estimate crashes and near-misses per million km of every combination of what the flags "
        "or SPEC.yaml name, with 95 % intervals, at the given rates of driver errors.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    evaluate.add_matrix(estimate, errors=FIELD)
    arguments.add(estimate, "--seeds", help="seeds A, A+1, ... B-1 (default: from 200000 on)")
    estimate.add_argument(
        "--episodes", type=arguments.count, metavar="N", help="of each cell, from the first seed on"
    )
    estimate.add_argument(
        "--tilt",
        metavar="TILT",
        help="factor on the frequency of each kind of error, KIND=FACTOR,... (all=FACTOR), or none "
        "(default: the scenario's)",
    )
    arguments.add(evaluate.add_work(estimate), "--json")
    estimate.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """0 when every episode has a row of any status.

    Raises BadInput before the first episode, or CosimError when the run cannot continue.
    """
    from cosim.batch import execution, matrix
    from cosim.files.yaml_input import document
    from cosim.policies import check
    from cosim.report import crash_rate, wording
    from cosim.report.summary import groups

    if args.out is None:
        raise BadInput("name the run's folder", field="--out")
    go_on = evaluate.continued(args)
    if go_on and args.tilt is not None:
        raise BadInput("a run continues with its own tilt", field="--tilt", value=args.tilt)
    if not (go_on or args.episodes or args.seeds or args.spec):
        raise BadInput("say how many: more episodes, a narrower interval", field="--episodes")
    cases, seeds = evaluate.asked(args)
    if args.episodes is not None:
        seeds = range(seeds.start, seeds.start + args.episodes)
    if not go_on:
        named = args.errors or (args.spec and document(Path(args.spec)).get("errors") is not None)
        cases = [_as_asked(case if named else replace(case, errors=FIELD), args) for case in cases]
    plan = matrix.plan(cases, seeds, check)
    if not args.resume:
        matrix.check_names(plan)
    engine = evaluate.engine_of(args)
    with evaluate.opened(plan, args, execution.begin_or_grow) as (store, folder):
        found = evaluate.driven("estimate", plan, engine, store, folder)
    found.warn()
    estimates = [(identity, crash_rate.estimate(rows)) for identity, rows in groups(found.rows)]
    if args.json:
        documents = [{**identity, **estimate} for identity, estimate in estimates]
        print(json.dumps(documents[0] if len(documents) == 1 else {"cells": documents}))
        return found.exit_code
    print(found.text(plan, folder))
    for identity, estimate in estimates:
        print(wording.group(identity))
        print(crash_rate.text(estimate))
    return found.exit_code


def _as_asked(case: EpisodeOptions, args: argparse.Namespace) -> EpisodeOptions:
    """The case with the tilt. Raises BadInput."""
    from cosim.scenario import tilt

    if args.tilt == "none" or case.errors is None:
        return case
    if args.tilt is not None:
        return replace(case, tilt=tilt.read(args.tilt).text())
    known = tilt.shipped(case.what) if case.errors == FIELD else None
    if known is None:
        print(
            f"cosim: no tilt is known for {case.what} with these errors: they are drawn as they happen",
            file=sys.stderr,
        )
    return case if known is None else replace(case, tilt=known.text())
