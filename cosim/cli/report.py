"""`cosim report`: a run as one HTML file to read and to pass on."""

import argparse
from pathlib import Path

from cosim.cli import arguments


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    report = commands.add_parser(
        "report",
        help="write a run's report: one HTML file",
        description="Write report.html: tables with intervals, plots, worst episodes, manifest. The file "
        "needs no network. An unfinished run is reported as far as it is driven.",
    )
    report.add_argument("run", metavar="DIR", help="run folder of `cosim evaluate`")
    arguments.add(report, "--out", metavar="FILE", help="write it here (default: DIR/report.html)")
    report.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Write the report and print its path."""
    from cosim.report import html as report
    from cosim.report.run_folder import read

    out = None if args.out is None else Path(args.out)
    print(report.write(read(args.run, unfinished=True), out, shown=args.run))
    return 0
