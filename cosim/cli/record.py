"""`cosim record`: drive episodes and record every vehicle, for training and measuring predictors."""

import argparse

from cosim.cli import arguments


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    record = commands.add_parser(
        "record",
        help="drive episodes and record every vehicle's states",
        description="Drive every combination of scenario, demand, behaviour, policy and seed on worker "
        "processes; one Parquet file per episode.",
    )
    arguments.options(record, matrix=True, without=("output", "metric", "reward", "sensing"))
    arguments.add(record, "--seeds", type=arguments.seeds, required=True)
    arguments.add(record, "--resume")
    arguments.add(record, "--out", required=True)
    arguments.add(record, "--workers", default=1, help="processes (1)")
    record.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Record; 3 when some episodes could not be driven."""
    import sys
    from pathlib import Path

    from cosim.batch.record import planned, record
    from cosim.errors import SimulationError

    wanted = planned(**vars(args))
    failed = record(Path(args.out), wanted, workers=args.workers, resume=args.resume)
    print(f"{wanted.episodes - len(failed)} episodes in {args.out}")
    for line in failed:
        print(f"cosim: not recorded: {line}", file=sys.stderr)
    return SimulationError.exit_code if failed else 0
