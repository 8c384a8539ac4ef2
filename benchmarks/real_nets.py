"""Nets that none of us wrote, driven as they stand: those of the eclipse-sumo package.

    python -m benchmarks.real_nets [--duration S] [--seeds N] [--workers N] [--out docs/results/real_nets.md]

Drives A10KW, a motorway interchange, to its end with SUMO's driver and with the agent, and every other
configuration of eclipse-sumo's games that loads; lists every collision with an explanation, and the memory.
Needs `pip install cosim-sumo[tools]`.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.tables import markdown_row, write_page
from cosim.episode import Episode, Hook, Step
from cosim.errors import CosimError
from cosim.host import Host
from cosim.road import RoadMap
from cosim.road.too_close import described, too_close
from cosim.scenario import Fleet, load
from cosim.scenario.vet import vetted
from cosim.types import Timing
from cosim.workers.worker import Worker

DECISION = Timing().decision  # s
FIRST_SEED = 200000
PENETRATION = 0.2
SEEDS = {"idm": 10, "vfn-p": 2}  # of A10KW; the other nets are driven by idm on one seed
SETTLED = 60.0  # s: the memory is read from then on
COLUMNS = {
    "inserted": "vehicles_inserted",
    "never inserted": "vehicles_never_inserted",
    "collisions": "collisions",
    "AV involved": "av_involved_collisions",
    "AV caused": "av_caused_collisions",
    "human only": "hv_hv_collisions",
    "insertion": "insertion_collisions",
    "wrecks removed": "wrecks_removed",
    "teleports": "teleports",
    "emergency stops": "emergency_stops",
}


@dataclass(frozen=True, slots=True)
class Run:
    """One episode that is wanted."""

    config: Path
    policy: str
    seed: int
    duration: float | None  # s; None: to its end


class Memory(Hook):
    """The process's resident memory in MB after `SETTLED` s, and at the end."""

    first = last = math.nan

    def on_step(self, episode: Episode, step: Step) -> None:
        if episode.elapsed >= SETTLED or math.isnan(self.last):
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
            self.last = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
            if math.isnan(self.first) or episode.elapsed < SETTLED + DECISION:
                self.first = self.last


class Driver:
    """Hosted in a process of its own, since a net may end SUMO and with it the process."""

    def __init__(self, run: Run) -> None:
        scenario = load(str(run.config), fleet=Fleet(penetration=PENETRATION), duration=run.duration)
        self._run = run
        self._host = Host(vetted(scenario), run.policy, svo=math.radians(45.0))

    def drive(self) -> dict[str, Any]:
        """The episode's document, with its memory and what is wrong with the net's lanes."""
        memory = Memory()
        document = self._host.run(self._run.seed, hooks=[memory]).document()
        road: RoadMap = self._host.simulator.road
        return {**document, "memory": (memory.first, memory.last), "lanes": described(road, too_close(road))}

    def close(self) -> None:
        """End the simulation."""
        self._host.close()


def a10kw() -> Path:
    """The configuration file of eclipse-sumo's game. Raises ImportError where that is not installed."""
    import sumo

    return Path(sumo.__file__).parent / "tools" / "game" / "A10KW.sumocfg"


def wanted(seeds: int | None, duration: float | None) -> Iterator[Run]:
    """Every run: A10KW with each policy, on at most `seeds` seeds, then other games with SUMO's driver."""
    big = a10kw()
    for policy, number in SEEDS.items():
        last = FIRST_SEED + min(number, seeds or number)
        yield from (Run(big, policy, seed, duration) for seed in range(FIRST_SEED, last))
    others = sorted(path for path in big.parent.glob("*.sumocfg") if path != big)
    yield from (Run(path, "idm", FIRST_SEED, duration) for path in others)


def drive(run: Run) -> dict[str, Any] | str:
    """The document of one run, or why there is none."""
    try:
        worker = Worker(Driver, run, timeout=600.0, name="real-nets")
        try:
            found: dict[str, Any] = worker.call("drive")
        finally:
            worker.close()
    except CosimError as error:
        return str(error).replace(f"{run.config.parent}/", "")
    return found


def explained(collision: dict[str, Any]) -> str:
    """One collision in a sentence: what happened, who saw it, whose it is."""
    collider, victim = (
        f"{'AV' if collision[f'{who}_is_av'] else 'HV'} `{collision[who]}`" for who in ("collider", "victim")
    )
    seen = "SUMO" if collision["source"] == "sumo" else "our boxes alone"
    if collision["kind"] == "insertion":
        what, whose = f"SUMO put {collider} and {victim} onto one another", "the demand's"
    else:
        what = f"{collider} moved into {victim} ({collision['kind']})"
        cut_in = collision["av_caused"] and not collision["collider_is_av"]
        whose = (
            "an AV's, which had just cut in" if cut_in else f"that of the {collider.split()[0]} that moved"
        )
    where = f"`{collision['lane']}`" if collision["lane"] else "off the lanes"
    return f"{collision['time']:,.1f} s, {where}: {what}; seen by {seen}; {whose}"


def page(runs: Sequence[Run], found: Sequence[dict[str, Any] | str], command: str) -> list[str]:
    """The Markdown page."""
    driven = [(run, one) for run, one in zip(runs, found, strict=True) if not isinstance(one, str)]
    heads = ["net", "policy", "seed", "preset", "simulated", *COLUMNS, "memory, MB"]
    lines = [
        "# Nets that none of us wrote",
        "",
        f"Made by `{command}`: the games of the `eclipse-sumo` package",
        f"(`pip install cosim-sumo[tools]`), driven as they stand, {PENETRATION:.0%} of the vehicles AVs.",
        "A10KW is a motorway interchange with bridges.",
        f"Memory: of the simulation's process, after {SETTLED:g} s and at the end.",
        "",
        markdown_row(heads),
        "|---" * len(heads) + "|",
    ]
    for run, one in driven:
        first, last = one["memory"]
        figures = (f"{one[key]:,}" if one.get(key) is not None else "-" for key in COLUMNS.values())
        cells = [run.config.stem, run.policy, str(run.seed), one["preset"]]
        cells += [f"{one['steps'] * DECISION:,.0f} s", *figures, f"{first:.0f}, {last:.0f}"]
        lines.append(markdown_row(cells))
    lines += ["", "## Every collision", ""]
    collisions = [
        f"- {run.config.stem}, {run.policy}, seed {run.seed}: {explained(c)}"
        for run, one in driven
        for c in one["collision_list"]
    ]
    lines += collisions or ["None."]
    lines += ["", "## Lanes too close together", ""]
    lanes = {run.config.stem: one["lanes"] for run, one in driven if one["lanes"]}
    lines += [f"- {name}: {text}" for name, text in lanes.items()] or ["None."]
    why: dict[str, list[str]] = {}
    for run, one in driven:
        for reason in one["not_comparable_because"]:
            why.setdefault(reason, []).append(f"{run.config.stem} {run.policy} {run.seed}")
    if why:
        lines += ["", "## Not comparable with other runs, and the results say so", ""]
        lines += [f"- {', '.join(names)}: {reason}" for reason, names in why.items()]
    refused = [(run, one) for run, one in zip(runs, found, strict=True) if isinstance(one, str)]
    if refused:
        lines += ["", "## Not driven", ""]
        lines += [f"- {run.config.stem}, {run.policy}, seed {run.seed}: {one}" for run, one in refused]
    return [
        *lines,
        "",
        "The tests drive A10KW's first 200 s with Table II's drivers (`--behavior mixed`), and with `vfn-p`",
        "its first 12 s (`tests/sumo/test_run.py`).",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--duration", type=float, metavar="S", help="default: to each scenario's end")
    parser.add_argument("--seeds", type=int, metavar="N", help=f"at most; default: {SEEDS}")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (1)")
    parser.add_argument("--out", type=Path, default=Path("docs/results/real_nets.md"), metavar="FILE.md")
    args = parser.parse_args(arguments)
    given = {"duration": args.duration, "seeds": args.seeds}
    limit = "".join(f" --{name} {value:g}" for name, value in given.items() if value is not None)
    runs = list(wanted(args.seeds, args.duration))
    with ThreadPoolExecutor(args.workers) as pool:
        found = list(pool.map(drive, runs))
    write_page(args.out, page(runs, found, f"python -m benchmarks.real_nets{limit}"))
    print(args.out)


if __name__ == "__main__":
    main()
