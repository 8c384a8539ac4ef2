"""Speed of `cosim join` in a running SUMO, alone and beside other TraCI clients.

    python -m benchmarks.joining [--rounds 5] [--seconds 20] [--small] [--out docs/results/joining.md]

Network: the motorway interchange A10KW of SUMO's package, with 200 vehicles. SUMO and every other client run
in separate processes; the conditions alternate. Run on an idle machine: under other load only the ratio by
processor time is valid.
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import sumo

import sumo_scenarios
from benchmarks.tables import markdown_row, write_page
from cosim.episode import Episode, Hook, Step
from cosim.host import Host, joining
from cosim.scenario import Fleet
from cosim.simulation.client import Client
from cosim.simulation.shared import theirs

GAME = Path(sumo.__file__).parent / "tools" / "game"
ADDITIONAL = (GAME / "input_additional.add.xml", GAME / "A10KW" / "osm.poly.xml", sumo_scenarios.TYPES)
WARMUP = 70.0  # s, until 200 vehicles are on the road
TARGET = 5.0  # times real time
ORDER, LIMIT = 9, 60.0
STEPS = """
import sys, traci
traci.init(int(sys.argv[1]), numRetries=60)
traci.setOrder(1)
try:
    while True:
        traci.simulationStep()
except traci.exceptions.FatalTraCIError:
    pass
"""
# SUMO's platoons (sumo/tools/simpla), formed by vehicles that are not AVs
PLATOONS = STEPS.replace("try:", "import simpla\nsimpla.load(sys.argv[2])\ntry:", 1)
PLATOONED = "mw_passenger"
SIMPLA = f"""<configuration>
    <vehicleSelectors value="{PLATOONED}"/>
    <verbosity value="0"/>
    <vTypeMap original="veh_{PLATOONED}" leader="DEFAULT_VEHTYPE" follower="DEFAULT_VEHTYPE"
        catchup="DEFAULT_VEHTYPE" catchupFollower="DEFAULT_VEHTYPE"/>
</configuration>
"""


class Condition(NamedTuple):
    """One condition: the preset, the AVs, and the other client of SUMO."""

    name: str
    other: str = ""  # code of the other client
    preset: str = "lawful"
    fleet: Fleet = Fleet(penetration=0.2)


CONDITIONS = (
    Condition("no other client"),
    Condition("no other client, preset unguarded", preset="unguarded"),
    Condition("beside a client that only steps", STEPS),
    Condition("beside SUMO's platoons (simpla)", PLATOONS, fleet=Fleet(ids=r"(?!veh_mw\d).*[0-2]")),
)


class Drive(NamedTuple):
    """Results of one drive."""

    ratio: float  # simulated time over wall time
    busy: float  # simulated time over the processor time of all processes
    vehicles: float  # mean over the decisions
    avs: float


class Clock(Hook):
    """Times and vehicle numbers after the warm-up; `others`: process ids."""

    def __init__(self, others: Sequence[int]) -> None:
        self._others = others

    def on_start(self, episode: Episode) -> None:
        """The warm-up has ended."""
        self._began = self._now()
        self.numbers: list[tuple[int, int]] = []

    def on_step(self, episode: Episode, step: Step) -> None:
        """A decision was executed."""
        self.numbers.append((step.after.n, len(step.after.avs)))
        self.wall, self.busy = (now - began for now, began in zip(self._now(), self._began, strict=True))

    def _now(self) -> tuple[float, float]:
        """Wall time and processor time of all processes, s (proc(5): stat, utime and stime)."""
        ticks = 0
        for process in self._others:
            ticks += sum(
                map(int, Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13])
            )
        return time.perf_counter(), time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def drive(condition: Condition, warmup: float, seconds: float, work: Path) -> Drive:
    """One drive of `seconds` counted s with random commands to every AV."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    settings = work / "simpla.cfg.xml"
    settings.write_text(SIMPLA, encoding="utf-8")
    options = [
        "--remote-port",
        str(port),
        "--num-clients",
        str(1 + bool(condition.other)),
        "--step-length",
        "0.1",
    ]
    options += ["--additional-files", ",".join(map(str, ADDITIONAL)), "--lanechange.duration", "2"]
    options += ["--collision.action", "warn", "--collision.mingap-factor", "0", "--time-to-teleport", "-1"]
    binary = str(GAME.parents[1] / "bin" / "sumo")
    commands = [[binary, "-c", str(GAME / "A10KW.sumocfg"), *options, "--collision.check-junctions"]]
    if condition.other:
        commands.append([sys.executable, "-c", condition.other, str(port), str(settings)])
    null = subprocess.DEVNULL
    programs = [subprocess.Popen(command, stdout=null, stderr=null) for command in commands]
    try:
        client = Client("localhost", port, ORDER, LIMIT)
        running, seed = theirs(client)
        times: dict[str, Any] = {"warmup": warmup, "duration": seconds}
        scenario = replace(running, fleet=condition.fleet, preset=condition.preset, **times)
        host = Host(scenario, "random", 0.0, simulator=joining(client))
        clock = Clock([p.pid for p in programs])
        try:
            result = host.run(seed, hooks=[clock])
        finally:
            host.close()
    finally:
        for program in programs:
            program.kill()
            program.wait()
    if ended := [reason for reason in result.validity if reason.startswith("ended")]:
        raise SystemExit(f"error: {condition.name}: {ended[0]}")
    vehicles, avs = (statistics.fmean(column) for column in zip(*clock.numbers, strict=True))
    return Drive(seconds / clock.wall, seconds / clock.busy, vehicles, avs)


def page(found: dict[str, list[Drive]], command: str) -> list[str]:
    """The Markdown page."""
    rows = []
    for name, drives in found.items():
        ratio, busy, vehicles, avs = zip(*drives, strict=True)
        target = f"at least {TARGET:g}: {'met' if statistics.median(ratio) >= TARGET else '**missed**'}"
        mean = [f"{statistics.fmean(column):.0f}" for column in (vehicles, avs)]
        rows.append([name, *mean, _median(ratio), _median(busy), target])
    return [
        "# Speed of `cosim join` in a running SUMO",
        "",
        f"Made by `{command}`: `cosim join` ([traci.md](../guides/traci.md))",
        f"on A10KW, a motorway interchange of SUMO's package, from {WARMUP:g} s on. Every AV gets a random",
        "command at every decision, without a network. SUMO, the agents and the other client run in one",
        "process each and wait for one another. On an idle machine both ratios are nearly equal. Values are",
        "medians (range).",
        "",
        markdown_row(["", "vehicles", "AVs", "times real time", "by processor time", "target"]),
        "|---|---|---|---|---|---|",
        *map(markdown_row, rows),
    ]


def _median(values: Sequence[float]) -> str:
    return f"{statistics.median(values):.1f} ({min(values):.1f} to {max(values):.1f})"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="default 5")
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="counted s of a drive")
    parser.add_argument("--small", action="store_true", help="one short drive; the figures are meaningless")
    parser.add_argument("--out", type=Path, metavar="FILE.md", help="default: printed")
    args = parser.parse_args(arguments)
    conditions, warmup = (CONDITIONS[:1], 2.0) if args.small else (CONDITIONS, WARMUP)
    os.environ["SUMO_HOME"] = str(GAME.parents[1])  # simpla finds SUMO's tools there
    found: dict[str, list[Drive]] = {condition.name: [] for condition in conditions}
    with tempfile.TemporaryDirectory(prefix="cosim-joining-") as work:
        for number in range(args.rounds):
            for condition in conditions:
                print(f"joining {number + 1}/{args.rounds}: {condition.name}", file=sys.stderr, flush=True)
                found[condition.name].append(drive(condition, warmup, args.seconds, Path(work)))
    command = f"python -m benchmarks.joining --rounds {args.rounds} --seconds {args.seconds:g}"
    write_page(args.out, page(found, command))


if __name__ == "__main__":
    main()
