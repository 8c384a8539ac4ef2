"""`cosim bench`: reproducible measurements.

`predict`: the predictors against recorded episodes. `attribution`: the effect of a value network's inputs.
"""

import argparse

from cosim.cli import arguments
from cosim.scenario import BEHAVIORS
from cosim.scenario.behaviors import AS_IS

DEMANDS = ("dense", "contested")
POLICIES = ("idm", "altruist-rule")  # without networks, so that the pages do not depend on shipped weights


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    kinds = commands.add_parser("bench", help="measure and write tables").add_subparsers(
        required=True, metavar="WHAT"
    )
    predict = kinds.add_parser(
        "predict",
        help="position error, interval coverage and map error of the predictors",
        description="Measure every predictor on recorded episodes; records missing episodes unless "
        "--recordings names a folder of `cosim record`. The first four flags may be repeated (default: all).",
    )
    arguments.add(predict, "--scenario", "--demand", "--behavior", "--policy", action="append", default=[])
    predict.add_argument(
        "--predictor",
        action="append",
        default=[],
        metavar="NAME|FILE:NAME",
        help="repeatable (all of ours); your own: a class called with horizon, dt",
    )
    arguments.add(predict, "--seeds", type=arguments.seeds, required=True, help="test seeds, B left out")
    predict.add_argument("--recordings", metavar="DIR", help="use these (seeds outside A:B are left out)")
    predict.add_argument("--no-maps", action="store_true", help="kinematics only (the maps take longer)")
    arguments.add(predict, "--workers", default=1)
    arguments.add(predict, "--out", required=True)
    predict.set_defaults(work=work)
    _add_attribution(kinds)


def work(args: argparse.Namespace) -> int:
    """Record missing episodes, measure, print the tables."""
    import shlex
    import sys
    from pathlib import Path

    import sumo_scenarios
    from cosim.batch.record import planned, record
    from cosim.errors import BadInput
    from cosim.files import prepare_folder
    from cosim.learning.bench_predict import MAPS_PAGE, PAGE, bench_maps, bench_predict
    from cosim.learning.prediction_data import recorded_by
    from cosim.recording.folder import Folder
    from cosim.scenario import load, place

    out = prepare_folder(args.out)
    where = Path(args.recordings) if args.recordings else out / "recordings"
    if not args.recordings:
        plan = planned(
            args.seeds,
            scenario=args.scenario or [*sumo_scenarios.names()],
            demand=args.demand or [*DEMANDS],
            behavior=args.behavior or [b for b in BEHAVIORS if b != AS_IS],
            policy=args.policy or [*POLICIES],
        )
        if failed := record(where, plan, workers=args.workers, resume=True):
            print(f"cosim: {len(failed)} episodes were not recorded: {failed[0]}", file=sys.stderr)
    elif args.demand or args.policy:
        raise BadInput("recordings are there already", field="--demand, --policy")
    folder = Folder(where)
    recorded = recorded_by(folder.manifest()) if args.recordings else []
    command = "\n".join([*recorded, "cosim " + shlex.join(sys.argv[1:])])
    named = [load(what).name if "/" in place(what) else what for what in args.scenario]
    wanted = {"scenarios": named, "behaviors": args.behavior, "seeds": args.seeds}
    bench_predict(folder, out, predictors=args.predictor, command=command, **wanted)
    print((out / PAGE).read_text())
    if not args.no_maps:
        bench_maps(folder, out, workers=args.workers, command=command, **wanted)
        print((out / MAPS_PAGE).read_text())
    return 0


def _add_attribution(kinds: arguments.SubCommands) -> None:
    command = kinds.add_parser(
        "attribution",
        help="which inputs of a value network change its choices",
        description="Drive episodes as `cosim run` does; at every decision ask the same network again with "
        "one input replaced. Writes attribution.csv, .md and .png, and closed_loop.csv with --closed-loop.",
    )
    arguments.add(command, "--policy", "--scenario", action="append", required=True)
    arguments.add(command, "--out", required=True)
    arguments.add(command, "--demand", default="")
    arguments.add(command, "--seeds", type=arguments.seeds, required=True)
    arguments.add(command, "--svo", default=45.0)
    arguments.add(command, "--duration", "--errors", "--preset")
    command.add_argument(
        "--closed-loop", action="store_true", help="also drive whole episodes with each input replaced"
    )
    command.add_argument(
        "--replace",
        action="append",
        metavar="INPUT",
        help="with --closed-loop this input alone, as 'all maps'; repeatable (default: every one)",
    )
    command.add_argument(
        "--by", default="dt_mission_m", metavar="FIGURE", help="of closed_loop.csv: which one is tested"
    )
    arguments.add(command, "--workers", default=1)
    command.set_defaults(work=work_attribution)


def work_attribution(args: argparse.Namespace) -> int:
    """Measure the attribution and print the page."""
    import shlex
    import sys

    from cosim.files import prepare_folder
    from cosim.learning.attribution import PAGE, attribution

    out = prepare_folder(args.out)
    what = (args.policy, args.scenario, args.demand, args.seeds, args.svo, args.duration)
    how = {
        "errors": args.errors,
        "preset": args.preset,
        "closed_loop": args.closed_loop,
        "by": args.by,
        "workers": args.workers,
    }
    how["replaced"] = args.replace or ()
    attribution(out, *what, **how, command="cosim " + shlex.join(sys.argv[1:]))
    print((out / PAGE).read_text(encoding="utf-8"))
    return 0
