"""Capacity of each open road with human drivers: capacity, capacity drop, flow against density.

    python -m benchmarks.capacity [--roads NAME ...] [--seeds A:B] [--again]

Demand rises in steps until traffic breaks down; a second run has a constant demand `over` the capacity found.
There are no AVs. Rows are kept in docs/results/data/capacity.csv. The page, its picture and
`sumo_scenarios/open/capacity.yaml` are made from the rows, the demands of the six roads from the latter.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from statistics import fmean, stdev
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks import published_capacity
from benchmarks.drives import read
from benchmarks.tables import markdown_head, markdown_row
from cosim.cli.arguments import seeds as seed_range
from cosim.scenario import Scenario, load
from cosim.scenario.vet import vetted
from cosim.seeding import TUNING_SEEDS
from cosim.simulation.sumo import SumoSimulator
from cosim.types import Timing
from research.picture import save
from sumo_scenarios import road_folders
from sumo_scenarios.roads import NAMED, Minor, Section

RESULTS = Path("docs/results")
DPI = 100.0  # of the points, which are no vectors
PAGE, PICTURE, DATA = "capacity.md", "capacity.svg", "data/capacity.csv"
RISING, OVER = "rising", "over"
# range of the rising demand, vehicles/h per lane at the bottleneck
SPAN = {
    "lane_drop": (1600.0, 2600.0),
    "on_ramp": (1500.0, 2500.0),
    "weave": (1300.0, 2500.0),
    "roundabout": (850.0, 1600.0),
    "minor": (750.0, 1900.0),
    "arterial": (1900.0, 3300.0),
}
STEP, STEPS = 120.0, 12  # s per step of the rising demand, number of steps
FILLING = 2  # minutes until the first vehicles have passed
CONSTANT = 720.0  # s of the demand `over`
SAMPLES = Timing(step=0.1, frame=1.0, decision=1.0)  # s: no decisions; the section is sampled every second
MINUTE = 60.0  # s, averaging period of a row
WINDOW = 5  # minutes of a flow rate, as in Brilon, Geistefeldt and Regler (2005)
# Breakdown: mean speed before the bottleneck below this share of the limit for `BREAKDOWN_TIME`
SLOW = {"lane_drop": 0.5, "on_ramp": 0.5, "weave": 0.5, "roundabout": 0.3, "minor": 0.3, "arterial": 0.3}
BREAKDOWN_TIME = 3  # minutes
DISCHARGE_DELAY = 2  # minutes from the breakdown to the measurement of the discharge


class Minute(NamedTuple):
    """A row of the CSV file: one minute of one drive."""

    road: str
    demand: str
    seed: int
    minute: int
    due_per_h: float
    flow_per_h: float
    density_per_km_lane: float
    speed_mps: float
    waiting: int  # vehicles waiting for insertion at the end of the minute


class Counter:
    """Simulates human drivers and counts them on a section."""

    def __init__(self, scenario: Scenario, section: Section) -> None:
        self._simulator = SumoSimulator(scenario)
        self._minutes = round(scenario.duration / MINUTE)
        self._decisions = round(MINUTE / scenario.timing.decision)
        lanes = self._simulator.road.lanes
        self._exit = np.array([lane.edge in section.exits for lane in lanes])
        self._from = np.array(  # m along the lane, beginning of the section
            [lane.length - section.reach if lane.edge in section.approaches else np.inf for lane in lanes]
        )
        of_section = [min(lane.length, section.reach) for lane in lanes if lane.edge in section.approaches]
        self._lane_km = sum(of_section) / 1000.0

    def drive(self, seed: int, slow: float | None) -> list[tuple[float, float, float, int]]:
        """Minute by minute: flow (vehicles/h), density (vehicles/km and lane), speed (m/s), waiting.

        `slow`: speed (m/s) of a breakdown, which ends the drive.
        """
        self._simulator.reset(seed)
        through: set[str] = set()
        found: list[tuple[float, float, float, int]] = []
        while len(found) < self._minutes:
            before = len(through)
            present, speed = self._minute(through)
            flow = (len(through) - before) * road_folders.HOUR / MINUTE
            found.append((flow, present / self._lane_km, speed, self._simulator.counts()["waiting"]))
            if slow is not None and breakdown([row[2] for row in found], slow) is not None:
                break
        return found

    def close(self) -> None:
        """End the simulation."""
        self._simulator.close()

    def _minute(self, through: set[str]) -> tuple[float, float]:
        """Mean number and mean speed of vehicles on the section; adds passed vehicles to `through`."""
        present, speeds = 0, 0.0
        for _ in range(self._decisions):
            snapshot = self._simulator.advance(())[1][-1]
            known = snapshot.lane >= 0
            through.update(snapshot.ids[k] for k in np.flatnonzero(self._exit[snapshot.lane] & known))
            here = (snapshot.lane_position >= self._from[snapshot.lane]) & known
            present += int(here.sum())
            speeds += float(snapshot.speed[here].sum())
        return present / self._decisions, speeds / present if present else math.nan


def slow(name: str) -> float:
    """Speed (m/s) before the bottleneck below which traffic has broken down."""
    road = NAMED[name]
    return SLOW[name] * (road.minor_speed if isinstance(road, Minor) else road.speed)


def breakdown(speeds: Sequence[float], slow: float) -> int | None:
    """The first minute with speeds below `slow` (m/s) for `BREAKDOWN_TIME` minutes."""
    for k in range(FILLING + WINDOW, len(speeds) - BREAKDOWN_TIME + 1):
        if all(speed < slow for speed in speeds[k : k + BREAKDOWN_TIME]):
            return k
    return None


def drive(
    name: str, demand: str, text: str, due: Sequence[float], seeds: Sequence[int]
) -> Iterator[list[Minute]]:
    """Drive the road `name` with the route file `text`, seed by seed; `due`: vehicles/h by minute."""
    if not seeds:
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{demand}.rou.xml"
        file.write_text(text, encoding="utf-8")
        duration = len(due) * MINUTE
        loaded = load(
            f"open/{name}", demand=[str(file)], behavior="moderate", penetration=0.0, duration=duration
        )
        scenario = replace(vetted(loaded), timing=SAMPLES)
        with closing(Counter(scenario, NAMED[name].section)) as counter:
            for seed in seeds:
                driven = counter.drive(seed, slow(name) if demand == RISING else None)
                print(f"{name} {demand} {seed}: {len(driven)} minutes", file=sys.stderr, flush=True)
                yield [Minute(name, demand, seed, k, due[k], *of) for k, of in enumerate(driven)]


def rising(name: str, seeds: Sequence[int]) -> Iterator[list[Minute]]:
    """Drives with a demand that rises until traffic breaks down."""
    road = NAMED[name]
    levels = [float(level) for level in np.linspace(*SPAN[name], STEPS) * road.lanes_at_bottleneck]
    text = road_folders.ramp(road, {k * STEP: level for k, level in enumerate(levels)}, STEP)
    due = [level for level in levels for _ in range(round(STEP / MINUTE))]
    return drive(name, RISING, text, due, seeds)


def over(name: str, capacity: float, seeds: Sequence[int]) -> Iterator[list[Minute]]:
    """Drives with a constant demand above capacity."""
    level = road_folders.LEVELS[OVER] * capacity
    text = road_folders.demand(NAMED[name], level, OVER, CONSTANT)
    return drive(name, OVER, text, [level] * round(CONSTANT / MINUTE), seeds)


def flows(rows: Sequence[Minute]) -> list[float]:
    """Vehicles/h in every window of `WINDOW` minutes after `FILLING`."""
    each = [row.flow_per_h for row in rows]
    return [fmean(each[k - WINDOW : k]) for k in range(FILLING + WINDOW, len(each) + 1)]


def before(rows: Sequence[Minute]) -> float:
    """The largest flow of a drive with rising demand, before its breakdown or else its end."""
    end = breakdown([row.speed_mps for row in rows], slow(rows[0].road))
    return max(flows(rows[:end]))


def after(rows: Sequence[Minute]) -> float | None:
    """The mean flow of a drive with demand `over`, from `DISCHARGE_DELAY` minutes after its breakdown."""
    begin = breakdown([row.speed_mps for row in rows], slow(rows[0].road))
    later = [] if begin is None else [row.flow_per_h for row in rows[begin + DISCHARGE_DELAY :]]
    return fmean(later) if later else None


def drives(rows: Sequence[Minute], name: str, demand: str) -> list[list[Minute]]:
    """The rows of each seed."""
    found: dict[int, list[Minute]] = {}
    for row in rows:
        if (row.road, row.demand) == (name, demand):
            found.setdefault(row.seed, []).append(row)
    return list(found.values())


def capacity(rows: Sequence[Minute], name: str) -> float:
    """Capacity in vehicles/h, the mean over seeds, rounded to ten."""
    return round(fmean(before(one) for one in drives(rows, name, RISING)), -1)


def measure(rows: list[Minute], names: Sequence[str], seeds: range, data: Path) -> None:
    """Drive the cases of these roads that `rows` lack; write `data` after every drive."""

    def missing(name: str, demand: str) -> list[int]:
        there = {row.seed for row in rows if (row.road, row.demand) == (name, demand)}
        return [seed for seed in seeds if seed not in there]

    def take(driven: Iterator[list[Minute]]) -> None:
        for one in driven:
            rows.extend(one)
            write(data, rows)

    for name in names:
        take(rising(name, missing(name, RISING)))
    for name in names:
        take(over(name, capacity(rows, name), missing(name, OVER)))


# ---- what is written ----


def write(file: Path, rows: Sequence[Minute]) -> None:
    """Write the rows to a CSV file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", encoding="utf-8", newline="") as lines:
        kept = csv.writer(lines, lineterminator="\n")
        kept.writerow(Minute._fields)
        kept.writerows([f"{v:.2f}" if isinstance(v, float) else v for v in row] for row in rows)


def page(rows: Sequence[Minute], picture: str) -> str:
    """The page."""
    names = [name for name in NAMED if drives(rows, name, RISING)]
    table = markdown_head(["road", *COLUMNS])
    table += [markdown_row([f"`open/{name}`", *cells(rows, name)]) for name in names]
    levels = markdown_head(["road", *road_folders.LEVELS])
    for name in names:
        each = (f"{share * capacity(rows, name):,.0f}" for share in road_folders.LEVELS.values())
        levels.append(markdown_row([f"`open/{name}`", *each]))
    return WORDS.format(table="\n".join(table), levels="\n".join(levels), picture=picture)


def cells(rows: Sequence[Minute], name: str) -> list[str]:
    """The cells of one road."""
    largest = [before(one) for one in drives(rows, name, RISING)]
    discharge = [flow for one in drives(rows, name, OVER) if (flow := after(one)) is not None]
    found = capacity(rows, name)
    dropped = f"{100.0 * (1.0 - fmean(discharge) / found):.0f}" if discharge else "-"
    return [
        f"{found:,.0f}",
        f"{stdev(largest):,.0f}" if len(largest) > 1 else "-",
        _broken(rows, name, RISING),
        f"{fmean(discharge):,.0f}" if discharge else "-",
        dropped,
        _broken(rows, name, OVER),
        f"{published_capacity.capacity(NAMED[name]):,.0f}",
    ]


def _broken(rows: Sequence[Minute], name: str, demand: str) -> str:
    """Number of drives with a breakdown, of all."""
    each = drives(rows, name, demand)
    hits = sum(breakdown([row.speed_mps for row in one], slow(name)) is not None for one in each)
    return f"{hits} of {len(each)}"


def picture(rows: Sequence[Minute], file: Path) -> None:
    """Plot flow against density: one panel per road, one point per minute."""
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    for axes, name in zip(figure.subplots(2, 3).flat, NAMED, strict=True):
        for demand, mark in ((RISING, "o"), (OVER, "x")):
            of = [row for row in rows if (row.road, row.demand) == (name, demand) and row.minute > 1]
            density = [row.density_per_km_lane for row in of]
            flow = [row.flow_per_h for row in of]
            axes.plot(density, flow, mark, markersize=2.5, label=demand, rasterized=True)
        axes.set_title(f"open/{name}", fontsize=9)
        axes.set_ylim(bottom=0.0)
    figure.supxlabel("density before the bottleneck, vehicles/km and lane")
    figure.supylabel("flow, vehicles/h")
    figure.axes[0].legend(fontsize=7)
    save(figure, file, DPI)


COLUMNS = (
    *("capacity, vehicles/h", "deviation", "drives that broke down", "discharge at `over`", "drop, %"),
    *("drives that broke down at `over`", "published capacity"),
)
WORDS = """# Capacity of the open roads

The largest flow of human drivers on each open road, without any AV. The demands of the roads are
shares of this capacity.

{table}

![Flow against density, by road]({picture})

- **Capacity** is the largest flow over five minutes before traffic breaks down, as demand rises. Five
  minutes follow Brilon, Geistefeldt and Regler (ISTTT 16, 2005). The table has the mean and the
  standard deviation over seeds; a drive without a breakdown counts with its largest flow.
- **Breakdown.** The mean speed before the bottleneck stays below half the limit for three minutes. At
  junctions the share is 30 %, since signals and gaps stop vehicles anyway.
- **Discharge** is the mean flow at the demand `over`, from two minutes after the breakdown on.
- **Published capacity** is HCM's, 6th edition (`benchmarks/published_capacity.py`), at the same shares
  of the flows. HCM's default drop on motorways is 7 %. Chung, Rudjanakanoknad and Cassidy (2007) found
  3 to 18 % at three bottlenecks.
- **Flow** counts vehicles of all origins that pass the bottleneck. **Density** is that of the approach.

## Demands

Vehicles per hour, for 15 minutes:

{levels}

## Conditions

Drivers `moderate` (IDM, LC2013), no driver errors, validation seeds from 100,000. A drop below 0
means a larger flow after the breakdown than before it, so there is no capacity drop. Each drive is
one seed, and seeds scatter. Rows by minute: [data/capacity.csv](data/capacity.csv). To measure again:
`python -m benchmarks.capacity --again`, with more seeds: `--seeds A:B`.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure missing cases; write rows, page and capacities."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    first = TUNING_SEEDS.start
    parser.add_argument("--roads", nargs="*", default=[*NAMED], choices=[*NAMED], metavar="NAME")
    parser.add_argument("--seeds", type=seed_range, default=f"{first}:{first + 3}", metavar="A:B")
    parser.add_argument("--again", action="store_true", help="also measure finished roads")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FOLDER")
    args = parser.parse_args(arguments)
    data = args.out / DATA
    rows = read(Minute, data)
    if args.again:
        rows = [row for row in rows if row.road not in args.roads]
    measure(rows, args.roads, args.seeds, data)
    picture(rows, args.out / PICTURE)
    (args.out / PAGE).write_text(page(rows, PICTURE), encoding="utf-8")
    if args.out == RESULTS and not {*NAMED} - {row.road for row in rows}:
        road_folders.keep({name: capacity(rows, name) for name in NAMED})
        road_folders.main()
    print(args.out / PAGE)


if __name__ == "__main__":
    main()
