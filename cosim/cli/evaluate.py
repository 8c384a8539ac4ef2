"""`cosim evaluate`: drive a whole matrix of episodes, resumable, on any number of worker processes."""

from __future__ import annotations

import argparse

from cosim.cli import arguments
from cosim.scenario import BEHAVIORS
from cosim.scenario.behaviors import DRIVER_MODELS
from cosim.types import Preset


def add(verbs: arguments.Verbs) -> None:
    """Register the verb and its flags."""
    evaluate = verbs.add_parser(
        "evaluate",
        help="drive a matrix of scenarios, demands, policies and seeds",
        description="Drive every combination of what the flags or SPEC.yaml name, once per seed. A flag that "
        "is given beside SPEC.yaml replaces that line of it.",
    )
    evaluate.add_argument("spec", nargs="?", metavar="SPEC.yaml", help="the matrix, by the flags' names")
    axes = evaluate.add_argument_group("the matrix (each flag may be repeated)")
    axes.add_argument(
        "--scenario", action="append", metavar="NAME|FILE", help="a world, or a .sumocfg, or a glob of them"
    )
    axes.add_argument(
        "--demand",
        action="append",
        metavar="NAME|FILES",
        help="a name, or a file or glob (.rou.xml, .trips.xml, flows, .gz); A,B is one demand of two files",
    )
    axes.add_argument("--policy", action="append", metavar="POLICY", help=arguments.POLICY)
    axes.add_argument("--behavior", action="append", choices=BEHAVIORS)
    axes.add_argument("--driver-model", action="append", choices=DRIVER_MODELS)
    axes.add_argument("--penetration", action="append", type=arguments.share, metavar="X", help="0..1")
    axes.add_argument("--svo", action="append", type=arguments.degrees, metavar="DEG", help="0..90")
    axes.add_argument("--preset", action="append", choices=Preset.ALL)
    axes.add_argument("--output", action="append", metavar="NAME", help="keep SUMO's own output of this name")
    evaluate.add_argument("--seeds", metavar="A:B", help="seeds A, A+1, ... B-1 (default 200000:200001)")
    evaluate.add_argument("--av-type", metavar="T", help="AVs are the vehicles of this vType")
    evaluate.add_argument("--av-ids", metavar="REGEX", help="AVs are the vehicles whose id matches")
    evaluate.add_argument("--duration", type=arguments.positive, metavar="S", help="counted s per episode")
    running = evaluate.add_argument_group("the work")
    running.add_argument("--out", metavar="DIR", help="the run's folder")
    running.add_argument("--resume", action="store_true", help="go on with what DIR holds")
    running.add_argument(
        "--workers", type=arguments.count, metavar="N", help="processes (default: all cores)"
    )
    running.add_argument("--engine", choices=("local", "ray"), default="local")
    running.add_argument("--ray-address", metavar="A", help="an existing cluster (default: a local one)")
    running.add_argument("--store", metavar="URL", help="a database instead of DIR/store.sqlite")
    running.add_argument("--step-timeout", type=arguments.positive, metavar="S", help="end a hung decision")
    running.add_argument("--reset-timeout", type=arguments.positive, metavar="S", help="end a hung start")
    running.add_argument("--no-report", action="store_true", help="leave report.html out")
    running.add_argument("--dry-run", action="store_true", help="print the matrix and an estimated time")
    running.add_argument("--json", action="store_true", help="print exactly one JSON document on stdout")
    evaluate.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """0 when every episode has its row, whatever the rows say."""
    from cosim.cli.evaluate_work import evaluate

    return evaluate(args)
