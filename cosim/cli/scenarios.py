"""`cosim scenarios`: the scenarios and their demands, as text or JSON."""

import argparse
import json
from typing import Any

from cosim.cli import arguments


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    scenarios = commands.add_parser(
        "scenarios",
        help="list the scenarios and their demands",
        description="List the scenarios that ship: demands, mission, duration, preset.",
    )
    arguments.add(scenarios, "--json")
    scenarios.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """List the scenarios."""
    from cosim.scenario import load
    from sumo_scenarios import names, open_roads

    rows: list[dict[str, Any]] = [
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
        for name, s in ((name, load(name)) for name in (*names(), *open_roads()))
    ]
    if args.json:
        print(json.dumps(rows))
        return 0
    for row in rows:
        print(f"{row['name']:<17}{row['title']}")
        default = row["default_demand"]
        demands = ", ".join(f"{d} (default)" if d == default else d for d in row["demands"])
        print(
            f"{'':<17}demand {demands}; mission {row['mission']}; "
            f"{row['duration_s']:g} s after {row['warmup_s']:g} s of warm-up; {row['preset']}"
        )
    return 0
