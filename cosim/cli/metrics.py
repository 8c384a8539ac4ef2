"""`cosim metrics`: cosim's figures for SUMO's floating-car data, with any drivers."""

import argparse
import json
import math
import re
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

from cosim.cli import arguments
from cosim.errors import BadInput


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    metrics = commands.add_parser(
        "metrics",
        help="measure time to collision, PET, DRAC, ... in existing floating-car data",
        description="Read SUMO's fcd-output (.xml, .xml.gz, any size), compute the figures of `cosim run`.",
    )
    metrics.add_argument("fcd", metavar="FCD", help="the file that SUMO's --fcd-output wrote")
    metrics.add_argument(
        "--types",
        action="append",
        default=[],
        metavar="FILE",
        help="route or additional file with the vTypes: lengths and widths; repeatable",
    )
    arguments.add(
        metrics,
        "--av-type",
        help="measure the vehicles of this vType (cosim.: every AV that cosim drove); default: all",
    )
    arguments.add(metrics, "--av-ids", help="measure the vehicles whose id matches")
    metrics.add_argument(
        "--begin", type=float, default=-math.inf, metavar="S", help="leave out frames before S"
    )
    metrics.add_argument("--end", type=float, default=math.inf, metavar="S", help="leave out frames after S")
    metrics.add_argument(
        "--frame", type=arguments.positive, metavar="S", help="s between frames (default: 0.2, or the file's)"
    )
    more = {
        "--net": ("NET", "the .net.xml: tells bridges and lane successions"),
        "--mission": ("REGEX", "measure these too, as mission vehicles"),
        "--conflicts": ("CSV", "write every conflict to this file: vehicles, time, place, distance, type"),
    }
    arguments.texts(metrics, more)
    metrics.add_argument(
        "--ttc",
        type=arguments.positive,
        metavar="S",
        help="a conflict is a time to collision below this (default 1.5)",
    )
    arguments.add(metrics, "--json")
    metrics.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Read the data, compute the figures, print them."""
    from cosim.fcd import Roles, analyse
    from cosim.fcd.encounters import Encounter
    from cosim.fcd.vehicle_types import read_sizes
    from cosim.files import cannot, write_csv
    from cosim.files.xml_input import regular_file
    from cosim.metrics.context import CRITICAL
    from cosim.report.result import figure
    from cosim.workers.progress import Progress

    path = regular_file(Path(args.fcd), file=None, field="FCD")
    types = [regular_file(Path(name), file=None, field="--types") for name in args.types]
    roles = Roles(args.av_type, _pattern(args.av_ids, "--av-ids"), _pattern(args.mission, "--mission"))
    road = None if args.net is None else _road(regular_file(Path(args.net), file=None, field="--net"))
    with Progress(path.name, "bytes") as progress:
        found = analyse(
            path,
            road=road,
            sizes=read_sizes(types) if types else None,
            roles=roles,
            frame=args.frame,
            critical=(args.ttc or CRITICAL) if args.conflicts else None,
            progress=progress,
            begin=args.begin,
            end=args.end,
        )
    if args.conflicts:
        file = Path(args.conflicts)
        with cannot("write", field="--conflicts", value=args.conflicts):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_csv(file, found.encounters, [field.name for field in fields(Encounter)])
        print(f"{len(found.encounters)} conflicts in {args.conflicts}", file=sys.stderr)
    whole: dict[str, Any] = {
        "file": str(path),
        "begin_s": found.begin,
        "end_s": found.end,
        "frame_s": found.interval,
        "frames": found.frames,
        "vehicles": found.vehicles,
        "watched": found.watched,
        **{name: metric.value for name, metric in found.figures.items()},
        "notes": list(found.notes),
        "units": {name: metric.unit for name, metric in found.figures.items()},
        "better": {name: metric.better for name, metric in found.figures.items()},
    }
    if args.json:
        print(json.dumps(whole))
        return 0
    print(
        f"{path}: {found.vehicles} vehicles ({found.watched} watched), {found.begin:g} to {found.end:g} s, "
        f"{found.frames} frames of {found.interval:g} s"
    )
    for name, metric in found.figures.items():
        print(f"  {name:<24} {figure(metric)}")
    for note in found.notes:
        print(f"  note: {note}")
    return 0


def _road(net: Path) -> Any:
    """The net as a RoadMap, read in a separate process that a bad net may crash."""
    from cosim.scenario.vet_net import read_net
    from cosim.simulation.net import NetReader
    from cosim.workers.worker import Worker

    read_net(net)
    with Worker(NetReader, net, name="cosim-net") as worker:
        return worker.call("road")


def _pattern(text: str | None, flag: str) -> re.Pattern[str] | None:
    try:
        return None if text is None else re.compile(text)
    except re.error as error:
        raise BadInput(f"not a regular expression: {error}", field=flag, value=text) from None
