"""`cosim record`: drive episodes and keep what every vehicle did, for learning and measuring prediction."""

from __future__ import annotations

import argparse

from cosim.cli import arguments
from cosim.scenario import BEHAVIORS


def add(verbs: arguments.Verbs) -> None:
    """Register the verb and its flags."""
    record = verbs.add_parser(
        "record",
        help="drive episodes and record every vehicle's states",
        description="Drive every combination of scenario, demand, behaviour, policy and seed on worker "
        "processes; one Parquet file an episode, written whole.",
    )
    record.add_argument(
        "--scenario",
        action="append",
        required=True,
        metavar="WHAT",
        help="a world, its folder or a .sumocfg; repeatable",
    )
    record.add_argument(
        "--demand", action="append", default=[], metavar="NAME|FILE", help="repeatable; one recording each"
    )
    record.add_argument("--behavior", action="append", default=[], choices=BEHAVIORS, help="repeatable")
    record.add_argument("--policy", action="append", default=[], metavar="POLICY", help=arguments.POLICY)
    record.add_argument("--svo", type=arguments.degrees, default=45.0, metavar="DEG", help="SVO angle, 0..90")
    record.add_argument("--seeds", type=seeds, required=True, metavar="A:B", help="A, A+1, ..., B-1")
    record.add_argument("--duration", type=arguments.positive, metavar="S")
    record.add_argument("--out", required=True, metavar="DIR")
    record.add_argument("--workers", type=arguments.count, default=1, metavar="N", help="processes (1)")
    record.add_argument("--resume", action="store_true", help="go on where an earlier call ended")
    record.set_defaults(work=work)


def seeds(text: str) -> range:
    """`a:b`, b not included; a single number is that one seed."""
    low, colon, high = text.partition(":")
    try:
        found = range(int(low), int(high) if colon else int(low) + 1)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no range of seeds A:B") from None
    if found.start < 0 or not found:
        raise argparse.ArgumentTypeError(f"{text!r} holds no seed (A:B with 0 <= A < B)")
    return found


def work(args: argparse.Namespace) -> int:
    """Record; 3 when some episodes could not be driven."""
    import sys
    from pathlib import Path

    from cosim.batch.record import cases, record
    from cosim.errors import SimulationError

    policies = args.policy or ["idm"]
    wanted = cases(args.scenario, args.demand, args.behavior, policies, args.seeds, args.svo, args.duration)
    failed = record(Path(args.out), wanted, workers=args.workers, resume=args.resume)
    print(f"{len(wanted) - len(failed)} episodes in {args.out}")
    for line in failed:
        print(f"cosim: not recorded: {line}", file=sys.stderr)
    return SimulationError.exit_code if failed else 0
