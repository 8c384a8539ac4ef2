"""Every table and figure of the papers, one after the other, then the summary; killed? the same goes on.

python -m benchmarks.papers [--scale 1] [--dry-run]        # `make results`
"""

from __future__ import annotations

import argparse

from benchmarks import altruism, prioritizer
from benchmarks.papers import (
    conditions,
    decisions,
    figure9,
    learning,
    phi,
    summary,
    t_figure8,
    t_figures,
    table3,
)
from benchmarks.papers.driving import add_arguments, settings_of
from benchmarks.papers.pages import run_jobs

JOBS = (
    table3.JOB,
    figure9.JOB,
    t_figures.JOB,
    t_figure8.JOB,
    phi.JOB,
    conditions.JOB,
    decisions.JOB,
    altruism.JOB,
    prioritizer.JOB,
)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.papers", description=__doc__)
    add_arguments(parser)
    args = parser.parse_args()
    settings = settings_of(args)
    run_jobs(JOBS, settings, args.dry_run)
    if not args.dry_run:
        learning.write(settings)
        summary.write(settings)


if __name__ == "__main__":
    main()
