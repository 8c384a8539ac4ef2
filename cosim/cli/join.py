"""`cosim join`: agents drive vehicles of a SUMO started by another program (docs/guides/traci.md)."""

from __future__ import annotations

import argparse
import math
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from cosim.cli import arguments
from cosim.cli.run import show
from cosim.errors import BadInput
from cosim.files import new_folder
from cosim.scenario import Scenario, with_options
from cosim.scenario.options import OPTIONS, TRAFFIC, of_flags
from cosim.scenario.policy_name import label

INTERRUPTED = "interrupted"


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    join = commands.add_parser(
        "join",
        help="drive vehicles of a SUMO started by another program",
        description="Join a SUMO that waits for TraCI clients (sumo --remote-port PORT --num-clients N), "
        "drive some of its vehicles as AVs, and hand them back. Ctrl-C leaves it in order.",
    )
    join.add_argument("place", metavar="HOST:PORT", type=_place, help="where it listens")
    theirs = [o.name for o in OPTIONS.values() if o.scope == TRAFFIC or o.field in ("outputs", "sensing")]
    arguments.options(
        join,
        without=theirs,
        duration="counted s (default: until the end in SUMO's configuration, else 60)",
        warmup="s driven before the counted time begins (default: 0)",
        preset="safety checks on the AVs (default: lawful)",
        mission="the mission vehicle: its id, a pattern of ids, none, or auto: guessed (default)",
        on_collision="of an AV or the mission vehicle (default: continue)",
    )
    arguments.add(join, "--out")
    arguments.add(join, "--seed", help="of the draw of AVs (default: SUMO's own)")
    arguments.texts(join, {"--net": ("FILE", "its net, where SUMO's own path of it does not hold here")})
    join.add_argument(
        "--order",
        type=int,
        default=9,
        metavar="N",
        help="place among its clients, another one for each; of two commands that of the higher one holds "
        "(default 9)",
    )
    limit = "s that SUMO may take to be there, and to answer (default 60)"
    join.add_argument("--timeout", type=arguments.positive, default=60.0, metavar="S", help=limit)
    join.add_argument("--replay", action="store_true", help="draw DIR/replay.html and DIR/replay.mp4 too")
    arguments.add(join, "--json")
    join.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Connect, drive in this process, hand back, show the result."""
    if args.replay and not args.out:
        raise BadInput("needs a run folder to write into: --out DIR", field="--replay")
    from cosim.host import Host, joining
    from cosim.policies import check, make
    from cosim.scenario.manifest import TRACI
    from cosim.simulation.client import Client
    from cosim.simulation.shared import theirs
    from cosim.workers.progress import Progress

    asked = of_flags({**vars(args), "scenario": "{}:{}".format(*args.place)})
    check(asked.policy)
    with new_folder(args.out) as folder:
        driver = make(asked.policy)  # before connecting, so that SUMO does not wait for it
        host_name, port = args.place
        client = Client(host_name, port, args.order, args.timeout)
        try:
            scenario, seed = theirs(client, args.net)
            host = Host(
                _warned(with_options(scenario, asked), client.place),
                driver,
                math.radians(asked.svo_deg),
                simulator=joining(client),
                metrics=asked.metrics,
                reward=asked.reward,
            )
        except BaseException:
            client.close()
            raise
        simulator: Any = host.simulator
        progress = Progress(f"{scenario.name} {label(asked.policy)}", "s")
        try:
            with _leaving(simulator):
                drive: Any = host.run_recorded if args.replay else host.run
                driven = drive(seed if args.seed is None else args.seed, progress)
        finally:
            progress.done()
            host.close()
    result, replay = driven if args.replay else (driven, None)
    shared = {TRACI: {"joined": client.place, "order": args.order}}
    result = replace(result, manifest=result.manifest | shared)
    show(args, [(result, replay)], folder, scenario.mission.kind)
    return 130 if simulator.leave else 0


def _warned(scenario: Scenario, place: str) -> Scenario:
    """The scenario with warnings about differences of the SUMO at `place` from cosim's."""
    from cosim.simulation.shared import lost

    return replace(
        scenario, warnings=(*scenario.warnings, *(f"{place}: {words}" for words in lost(scenario)))
    )


@contextmanager
def _leaving(simulator: Any) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the drive before the next step, so that SUMO stays consistent; a second signal
    while SUMO does not answer ends it at once."""

    def leave(*_: object) -> None:
        if simulator.leave:
            raise KeyboardInterrupt
        simulator.leave = INTERRUPTED

    before = {number: signal.signal(number, leave) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _place(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT")
    return host or "localhost", arguments.port(port)
