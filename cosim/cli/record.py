"""`cosim record`: drive episodes and keep what every vehicle did, for learning and measuring prediction."""

import argparse

from cosim.cli import arguments


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    record = commands.add_parser(
        "record",
        help="drive episodes and record every vehicle's states",
        description="Drive every combination of scenario, demand, behaviour, policy and seed on worker "
        "processes; one Parquet file an episode, written whole. The first four flags may be repeated.",
    )
    arguments.add(record, "--scenario", action="append", required=True)
    arguments.add(record, "--demand", "--behavior", "--policy", action="append", default=[])
    arguments.add(record, "--svo", default=45.0)
    arguments.add(record, "--seeds", type=arguments.seeds, required=True)
    arguments.add(record, "--duration", "--warmup", "--mission", "--on-collision", "--errors", "--resume")
    arguments.add(record, "--out", required=True)
    arguments.add(record, "--workers", default=1, help="processes (1)")
    record.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Record; 3 when some episodes could not be driven."""
    import sys
    from pathlib import Path

    from cosim.batch.record import planned, record
    from cosim.errors import SimulationError

    policies = args.policy or ["idm"]
    times = {
        "duration": args.duration,
        "warmup": args.warmup,
        "mission": args.mission,
        "on_collision": args.on_collision,
        "errors": args.errors,
    }
    wanted = planned(args.scenario, args.demand, args.behavior, policies, args.seeds, args.svo, **times)
    failed = record(Path(args.out), wanted, workers=args.workers, resume=args.resume)
    print(f"{wanted.episodes - len(failed)} episodes in {args.out}")
    for line in failed:
        print(f"cosim: not recorded: {line}", file=sys.stderr)
    return SimulationError.exit_code if failed else 0
