"""A net that none of us wrote, driven as it stands: the motorway interchange of the eclipse-sumo package.

    python -m benchmarks.real_nets [--duration S] [--out docs/results/real_nets.md]

Runs `cosim run` on A10KW.sumocfg to its end. Needs `pip install cosim-sumo[tools]`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import markdown_row, write_page
from cosim.types import Timing

DECISION = Timing().decision  # s
FLAGS = ("--penetration", "0.2", "--policy", "idm", "--seed", "200000")
COLUMNS = {
    "vehicles inserted": "vehicles_inserted",
    "never inserted": "vehicles_never_inserted",
    "collisions": "collisions",
    "HV-HV": "hv_hv_collisions",
    "teleports": "teleports",
    "emergency stops": "emergency_stops",
}


def a10kw() -> Path:
    """The configuration file of eclipse-sumo's game. Raises ImportError where that is not installed."""
    import sumo

    return Path(sumo.__file__).parent / "tools" / "game" / "A10KW.sumocfg"


def drive(duration: float | None) -> dict[str, Any]:
    """The document of one run."""
    limit = [] if duration is None else ["--duration", f"{duration:g}"]
    command = [sys.executable, "-m", "cosim.cli.main", "run", str(a10kw()), *FLAGS, *limit, "--json"]
    found: dict[str, Any] = json.loads(
        subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    )
    return found


def page(found: dict[str, Any], command: str) -> list[str]:
    """The Markdown page."""
    why = found["not_comparable_because"]
    return [
        "# A net that none of us wrote",
        "",
        f"Made by `{command}`: A10KW is a motorway interchange with bridges that the `eclipse-sumo` package",
        "ships (`pip install cosim-sumo[tools]`), driven as it stands:",
        "",
        "```",
        f"cosim run A10KW.sumocfg {' '.join(FLAGS)} --json",
        "```",
        "",
        markdown_row(["behaviour", "simulated", *COLUMNS]),
        "|---" * (len(COLUMNS) + 2) + "|",
        markdown_row(
            [
                found["behavior"],
                f"{found['steps'] * DECISION:,.0f} s",
                *(f"{found[key]:,}" if key in found else "-" for key in COLUMNS.values()),
            ]
        ),
        "",
        *(["Not comparable with other runs, and the result says so:", ""] if why else []),
        *(f"- {reason}" for reason in why),
        "",
        "The tests drive its first 200 s with Table II's drivers (`--behavior mixed`), and with `vfn-p` its",
        "first 12 s (`tests/sumo/test_run.py`).",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--duration", type=float, metavar="S", help="default: to the scenario's end")
    parser.add_argument("--out", type=Path, default=Path("docs/results/real_nets.md"), metavar="FILE.md")
    args = parser.parse_args(arguments)
    limit = "" if args.duration is None else f" --duration {args.duration:g}"
    write_page(args.out, page(drive(args.duration), f"python -m benchmarks.real_nets{limit}"))
    print(args.out)


if __name__ == "__main__":
    main()
