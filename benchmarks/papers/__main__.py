"""Every table and figure of the papers, one after the other, then the summary; killed? the same goes on.

python -m benchmarks.papers [--scale 1] [--dry-run] [--anew]        # `make results`
"""

from __future__ import annotations

import argparse

from benchmarks.papers import learning, summary
from benchmarks.papers.driving import add_arguments, settings_of
from benchmarks.papers.jobs import JOBS
from benchmarks.papers.pages import run_jobs


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
