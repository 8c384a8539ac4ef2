"""The command line: `cosim run`, `cosim scenarios`, `cosim doctor`."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from typing import Any

from cosim.errors import CosimError
from cosim.scenario import BEHAVIORS, DRIVER_MODELS, Fleet
from cosim.types import Preset


def main(argv: Sequence[str] | None = None) -> int:
    """Exit codes: 0 finished, 2 bad input, 3 simulator failure, 4 our own failure, 130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    options: list[str] = []
    if "--" in arguments:
        cut = arguments.index("--")
        arguments, options = arguments[:cut], arguments[cut + 1 :]
    args = parser().parse_args(arguments)
    args.sumo_options = options
    try:
        return int(args.work(args))
    except CosimError as error:
        print(f"cosim: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("cosim: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `cosim ... | head`
        sys.stderr.close()
        return 0


def parser() -> argparse.ArgumentParser:
    """Every verb and flag."""
    top = argparse.ArgumentParser(
        prog="cosim", description="Altruistic cooperative driving in mixed traffic on SUMO."
    )
    verbs = top.add_subparsers(required=True, metavar="VERB")

    run = verbs.add_parser(
        "run",
        help="drive one episode of a scenario",
        description="Drive one episode. Everything after -- goes to SUMO as it stands.",
    )
    run.add_argument("what", metavar="WHAT", help="a scenario's name (cosim scenarios) or any .sumocfg")
    run.add_argument(
        "--demand", action="append", default=[], metavar="NAME|FILE", help="demand by name, or route files"
    )
    run.add_argument("--policy", default="idm", metavar="NAME", help="who commands the AVs (default idm)")
    run.add_argument("--svo", type=_degrees, default=45.0, metavar="DEG", help="SVO angle, 0..90")
    run.add_argument("--behavior", choices=BEHAVIORS, help="Table II class of the human drivers")
    run.add_argument("--driver-model", choices=DRIVER_MODELS, default="lc2013")
    run.add_argument("--preset", choices=Preset.ALL, help="who guards the AVs (default: the scenario's)")
    fleet = run.add_mutually_exclusive_group()
    fleet.add_argument("--av-type", metavar="T", help="AVs are the vehicles of this vType")
    fleet.add_argument("--av-ids", metavar="REGEX", help="AVs are the vehicles whose id matches")
    fleet.add_argument("--penetration", type=_share, metavar="P", help="this share of vehicles are AVs, 0..1")
    run.add_argument("--seed", type=_seed, default=200_000, metavar="N")
    run.add_argument("--duration", type=_positive, metavar="S", help="counted s (default: the scenario's)")
    run.add_argument("--out", metavar="DIR", help="write the run folder here")
    run.add_argument("--json", action="store_true", help="print exactly one JSON document on stdout")
    run.set_defaults(work=_run)

    scenarios = verbs.add_parser("scenarios", help="list the worlds and their demands")
    scenarios.add_argument("--json", action="store_true")
    scenarios.set_defaults(work=_scenarios)

    doctor = verbs.add_parser("doctor", help="check this installation and say how to mend it")
    doctor.add_argument("--json", action="store_true")
    doctor.set_defaults(work=_doctor)
    return top


def _run(args: argparse.Namespace) -> int:
    from cosim.app import output
    from cosim.app.progress import Progress
    from cosim.app.runner import Runner
    from cosim.scenario import load
    from cosim.vet import vetted
    from cosim.worker import Worker
    from policy.agents import check_name

    fleet = None
    if args.av_type is not None or args.av_ids is not None or args.penetration is not None:
        fleet = Fleet(args.av_type, args.av_ids, args.penetration)
    check_name(args.policy)
    scenario = load(
        args.what,
        demand=args.demand,
        behavior=args.behavior,
        driver_model=args.driver_model,
        preset=args.preset,
        fleet=fleet,
        duration=args.duration,
        options=args.sumo_options,
    )
    scenario = vetted(scenario)
    folder = output.prepare_folder(args.out) if args.out else None
    progress = Progress(f"{scenario.name} {args.policy}", "s")
    with Worker(Runner, scenario, args.policy, math.radians(args.svo), name="cosim-run") as worker:
        result = worker.call("run", args.seed, progress=progress)
    progress.done()
    if folder is not None:
        output.write_folder(folder, result)
    if args.json:
        print(json.dumps(output.document(result)))
    else:
        print(output.table(result))
        if folder is not None:
            print(f"  run folder               {folder}")
    return 0


def _scenarios(args: argparse.Namespace) -> int:
    from cosim.scenario import load
    from sumo_scenarios import names

    rows: list[dict[str, Any]] = []
    for name in names():
        s = load(name)
        rows.append(
            {
                "name": name,
                "title": s.title,
                "demands": sorted(s.demands or {}),
                "default_demand": s.demand_name,
                "mission": s.mission.kind,
                "duration_s": s.duration,
                "warmup_s": s.warmup,
                "preset": s.preset,
            }
        )
    if args.json:
        print(json.dumps(rows))
        return 0
    for row in rows:
        print(f"{row['name']:<14}{row['title']}")
        print(
            f"{'':<14}demand {', '.join(row['demands'])}; mission {row['mission']}; "
            f"{row['duration_s']:g} s after {row['warmup_s']:g} s of warm-up; {row['preset']}"
        )
    return 0


def _doctor(args: argparse.Namespace) -> int:
    from cosim.app.doctor import doctor

    return doctor(args.json)


def _number(text: str, low: float, high: float, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value


def _degrees(text: str) -> float:
    return _number(text, 0.0, 90.0, "an angle from 0 to 90 degrees")


def _share(text: str) -> float:
    return _number(text, 0.0, 1.0, "a share from 0 to 1")


def _positive(text: str) -> float:
    return _number(text, 0.1, 1e6, "a positive number of seconds")


def _seed(text: str) -> int:
    value = _number(text, 0, 2**62, "a whole number of 0 or more")
    if value != int(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
