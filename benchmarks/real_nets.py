"""Unmodified networks of other authors: the games of the eclipse-sumo package.

    python -m benchmarks.real_nets [--duration S] [--seeds N] [--nets NAME ...] [--workers N]
                                   [--runs FILE.csv] [--held] [--out docs/results/real_nets.md]

Drives A10KW, a motorway interchange, and every other configuration that loads, with SUMO's driver in every
AV. Measures time, memory, collisions and offences. Episodes in `--runs` (default: the page's) are not driven
again. `--held` drives nothing. Needs `pip install '.[tools]'`.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import fmean

from benchmarks.tables import markdown_row, write_page
from cosim.episode import Episode, Hook, Step
from cosim.errors import CosimError
from cosim.files import write_csv
from cosim.host import Host
from cosim.scenario import Fleet, load
from cosim.scenario.vet import vetted
from cosim.workers.worker import Worker

POLICY = "idm"
FIRST_SEED = 200000
SEEDS = 10  # of A10KW; one for every other network
PENETRATION = 0.2
LONGEST = 10_000.0  # s, limit for scenarios that last for days
MEMORY_START = 60.0  # s, first reading of the memory
KEPT = Path("docs/results/data/real_nets.csv")
PAGE = Path("docs/results/real_nets.md")
OFFENCES = ("red_light_violations", "stop_sign_violations", "right_of_way_violations")
COLUMNS = (
    *("network", "seeds", "simulated, s", "AVs", "collisions", "caused by AVs", "offences", "AVs stuck"),
    *("memory, MB", "times real time"),
)


@dataclass(frozen=True, slots=True)
class Run:
    """One requested episode."""

    config: Path
    seed: int
    duration: float | None  # s; None: to the scenario's end

    @property
    def key(self) -> tuple[str, int]:
        """Network and seed."""
        return self.config.stem, self.seed


@dataclass(frozen=True, slots=True)
class Driven:
    """Results of an episode; a row of the CSV file."""

    network: str
    seed: int
    simulated_s: float
    avs: int
    collisions: int
    av_caused: int
    offences: int  # of AVs: red lights, stop signs, failures to yield
    stuck: int  # AVs
    memory_mb: float  # of the simulation's process, at the end
    growth_mb: float  # since `MEMORY_START`
    took_s: float
    trace_hash: str


TYPES = {one.name: {"str": str, "int": int, "float": float}[str(one.type)] for one in fields(Driven)}


class Cost(Hook):
    """Resident memory of the process in MB after `MEMORY_START` s and at the end, and all AVs."""

    first = last = math.nan

    def on_start(self, episode: Episode) -> None:
        self.avs: set[str] = set()

    def on_step(self, episode: Episode, step: Step) -> None:
        self.avs.update(step.after.avs)
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        self.last = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        if episode.elapsed <= MEMORY_START or math.isnan(self.first):
            self.first = self.last


class Driver:
    """Runs in a separate process, since a network may crash SUMO and with it the process."""

    def __init__(self, run: Run) -> None:
        fleet = Fleet(penetration=PENETRATION)
        duration = min(run.duration or math.inf, load(str(run.config), fleet=fleet).duration, LONGEST)
        scenario = load(str(run.config), fleet=fleet, duration=duration)
        self._run = run
        self._host = Host(vetted(scenario), POLICY, svo=math.radians(45.0))

    def drive(self) -> Driven:
        """Drive the episode; return its results and cost."""
        cost = Cost()
        began = time.perf_counter()
        document = self._host.run(self._run.seed, hooks=[cost]).document()
        return Driven(
            *self._run.key,
            simulated_s=round(document["steps"] * self._host.episode.scenario.timing.decision, 1),
            avs=len(cost.avs),
            collisions=document["collisions"],
            av_caused=document["av_caused_collisions"],
            offences=sum(document[name] or 0 for name in OFFENCES),
            stuck=document["avs_stuck"] or 0,
            memory_mb=round(cost.last, 1),
            growth_mb=round(cost.last - cost.first, 1),
            took_s=round(time.perf_counter() - began, 1),
            trace_hash=document["trace_hash"],
        )

    def close(self) -> None:
        """End the simulation."""
        self._host.close()


def a10kw() -> Path:
    """The configuration file of A10KW in eclipse-sumo. Raises ImportError without that package."""
    import sumo

    return Path(sumo.__file__).parent / "tools" / "game" / "A10KW.sumocfg"


def wanted(seeds: int, duration: float | None, nets: Sequence[str] | None) -> Iterator[Run]:
    """Every run: A10KW on `seeds` seeds, then the other games on one."""
    big = a10kw()
    for config in (big, *sorted(path for path in big.parent.glob("*.sumocfg") if path != big)):
        if nets is None or config.stem in nets:
            last = FIRST_SEED + (seeds if config == big else 1)
            yield from (Run(config, seed, duration) for seed in range(FIRST_SEED, last))


def drive(run: Run) -> Driven | str:
    """The results of a run, or the reason why it was refused."""
    try:
        worker = Worker(Driver, run, timeout=3600.0, name="real-nets")
        try:
            found: Driven = worker.call("drive")
        finally:
            worker.close()
    except CosimError as error:
        return str(error).replace(f"{run.config.parent}/", "")
    return found


def read(file: Path) -> dict[tuple[str, int], Driven]:
    """The rows of a CSV file, by network and seed; empty without a file."""
    if not file.is_file():
        return {}
    with file.open(newline="", encoding="utf-8") as lines:
        typed = [{name: TYPES[name](text) for name, text in row.items()} for row in csv.DictReader(lines)]
    rows = [Driven(**row) for row in typed]
    return {(row.network, row.seed): row for row in rows}


def keep(file: Path, rows: Sequence[Driven]) -> None:
    """Write the CSV file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_csv(file, [asdict(row) for row in rows])


def line(rows: Sequence[Driven]) -> list[str]:
    """The cells of one network: sums over its seeds, means of memory and time."""
    simulated, took = sum(row.simulated_s for row in rows), sum(row.took_s for row in rows)
    names = ("collisions", "av_caused", "offences", "stuck")
    counts = (sum(getattr(row, name) for row in rows) for name in names)
    return [
        *(rows[0].network, str(len(rows)), f"{simulated:,.0f}", f"{sum(row.avs for row in rows):,}"),
        *map(str, counts),
        *(f"{fmean(row.memory_mb for row in rows):.0f}", f"{simulated / took:.1f}"),
    ]


def page(rows: Sequence[Driven], lacking: Sequence[str], command: str) -> list[str]:
    """The Markdown page; `lacking`: a line for every missing run."""
    names = dict.fromkeys(row.network for row in rows)
    networks = {name: [row for row in rows if row.network == name] for name in names}
    populated = {name: of for name, of in networks.items() if any(row.avs for row in of)}
    return [
        "# Do networks of other authors run unmodified?",
        "",
        f"**{'No' if lacking else 'Yes'}.** {len(networks)} networks of the `eclipse-sumo` package",
        f"are driven to their end, or for {LONGEST:,.0f} s. {len(lacking)} runs are missing.",
        f"{len(populated)} networks have AVs.",
        "",
        markdown_row(COLUMNS),
        "|---" * len(COLUMNS) + "|",
        *(markdown_row(line(of)) for of in populated.values()),
        "",
        "## Conditions",
        "",
        f"{PENETRATION:.0%} of the vehicles are AVs, driven by SUMO (`{POLICY}`) without any value network.",
        f"Seeds from {FIRST_SEED:,}. Offences are red lights, stop signs and failures to",
        "yield of AVs. An AV is stuck if it stands without a reason. Memory is that of the simulation's",
        f"process at the end. Times are from a shared machine. Rows: [data/{KEPT.name}](data/{KEPT.name}).",
        "",
        "```",
        command,
        "```",
        *(["", "Missing:", "", *(f"- {why}" for why in lacking)] if lacking else []),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--duration", type=float, metavar="S", help="default: to each scenario's end")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help=f"of A10KW ({SEEDS})")
    parser.add_argument("--nets", nargs="+", metavar="NAME", help="networks (A10KW, grid6 ...); default: all")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (1)")
    parser.add_argument("--runs", type=Path, default=KEPT, metavar="FILE.csv")
    parser.add_argument(
        "--held", action="store_true", help="drive nothing, write the page from the driven episodes"
    )
    parser.add_argument("--out", type=Path, default=PAGE, metavar="FILE.md")
    args = parser.parse_args(arguments)
    runs, held = list(wanted(args.seeds, args.duration, args.nets)), read(args.runs)
    todo = [] if args.held else [run for run in runs if run.key not in held]
    with ThreadPoolExecutor(args.workers) as pool:
        found = list(pool.map(drive, todo))
    held |= {(row.network, row.seed): row for row in found if isinstance(row, Driven)}
    if todo:
        keep(args.runs, list(held.values()))
    refused = {run.key: str(why) for run, why in zip(todo, found, strict=True)}
    lacking = [
        f"{run.config.stem}, seed {run.seed}: {refused.get(run.key, 'not driven')}"
        for run in runs
        if run.key not in held
    ]
    limits = [f"--duration {args.duration:g}"] if args.duration else []
    limits += [f"--seeds {args.seeds}"] if args.seeds != SEEDS else []
    limits += [f"--nets {' '.join(args.nets)}"] if args.nets else []
    rows = [held[run.key] for run in runs if run.key in held]
    write_page(args.out, page(rows, lacking, " ".join(["python -m benchmarks.real_nets", *limits])))
    print(args.out)


if __name__ == "__main__":
    main()
