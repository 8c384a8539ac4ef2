"""`cosim compare`: two policies or two runs on equal seeds, and whether B may replace A."""

import argparse
import json
from pathlib import Path

from cosim.cli import arguments
from cosim.errors import BadInput
from cosim.files import cannot

EPILOG = """\
A and B are run folders of `cosim evaluate`, or DIR:POLICY for one policy of it. With one folder, name both
policies: cosim compare DIR --baseline idm --candidate altruist-rule. Two folders without a policy that hold
several are compared policy by policy.

thresholds:  METRIC[.upper|.lower]  >|<  [+|-]NUMBER[UNIT]
  collision_rate > +0.5pp         B crashes in half a percentage point more of the episodes than A
  collision_rate.upper > +2pp     the upper bound of that difference is above two points
  collision_rate > 2%             B crashes in more than 2 % of the episodes, whatever A does
  dt_av_m < -5%                   B's AVs get 5 % less far than A's
  dt_mission_m < +50m             B's mission vehicle does not get 50 m further than A's

An unfinished batch is shown as far as it is; its thresholds are not judged (exit code 2) without --partial.

exit codes:  0 passed, 1 a threshold failed, 2 bad input or an unfinished batch, 3 simulations failed
"""


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    compare = commands.add_parser(
        "compare",
        help="compare two policies or runs on equal seeds, with thresholds for CI",
        description="Compare A (baseline) with B (candidate), pair by pair on equal seeds.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    compare.add_argument("a", metavar="A", help="run folder, or DIR:POLICY")
    compare.add_argument("b", metavar="B", nargs="?", help="the same; default: A's folder")
    names = "behavior, penetration, preset, errors, sensing, svo_deg, driver_model"
    repeatable = {
        "--fail-on": ("THRESHOLD", "see below; repeatable"),
        "--across": ("FIELD", f"A and B may differ in this: {names}; repeatable"),
    }
    once = {
        "--baseline": ("POLICY", "the policy of A"),
        "--candidate": ("POLICY", "the policy of B"),
        "--junit": ("FILE", "write a JUnit file"),
        "--markdown": ("FILE", "write a table for a pull request comment"),
    }
    arguments.texts(compare, once)
    arguments.texts(compare, repeatable, action="append", default=[])
    compare.add_argument(
        "--partial", action="store_true", help="judge an unfinished batch by its finished episodes"
    )
    arguments.add(compare, "--json")
    compare.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Compare and show; the exit code reports whether B passed."""
    from cosim.report import verdict
    from cosim.report.compare import compare
    from cosim.report.pairing import chosen, side

    a = side(args.a)
    if args.b is None and (args.baseline is None or args.candidate is None):
        problem = "with one run name both policies: --baseline and --candidate"
        raise BadInput(problem, field="B")
    b = side(args.b) if args.b is not None else a
    a = a if args.baseline is None else chosen(a.run, args.baseline)
    b = b if args.candidate is None else chosen(b.run, args.candidate)
    found = compare(a, b, args.fail_on, across=args.across, partial=args.partial)
    if args.junit is not None:
        with cannot("write", field="--junit", value=args.junit):
            verdict.junit(found, Path(args.junit))
    if args.markdown is not None:
        with cannot("write", field="--markdown", value=args.markdown):
            Path(args.markdown).write_text(verdict.markdown(found), "utf-8")
    print(json.dumps(verdict.document(found)) if args.json else verdict.text(found))
    return found.exit_code
