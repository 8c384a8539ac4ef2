"""AVs of preset `lawful` among humans who err (`--errors stress`), beside plain `idm`.

    python -m benchmarks.humans [--episodes 400] [--policy vfn-p ...] [--runs runs/humans] [--workers 2]
    python -m benchmarks.humans --taken-away [--episodes 30]

The first drives the same test seeds in every world, each in the demand of `DEMAND`, and goes on where it
stopped; further policies may be added later. The second, on tuning seeds, drives AVs that always ask for more
speed, and takes the parts of the car's answer to who follows away, one by one. Each writes its own part of
docs/results/humans.md.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.error_levels import fill
from benchmarks.tables import markdown_row
from cosim.cli.main import main as cosim
from cosim.host import Host
from cosim.report import run_folder, statistics
from cosim.report.figures import Row
from cosim.scenario import load
from cosim.scenario.human_errors import levels
from cosim.scenario.vet import vetted
from cosim.seeding import FIRST_TEST_SEED, TUNING_SEEDS
from cosim.types import Decision, EpisodeResult, History, MetaAction, ObservationConfig, PolicyContext, Preset
from cosim.workers.tasks import OK
from cosim.workers.worker import Worker

PAGE = Path("docs/results/humans.md")
# In `contested` most happens; there the AVs of a motorway that nobody disturbs are hardly ever hit.
DEMAND = {
    "merge": "contested",
    "exit": "contested",
    "roundabout": "contested",
    "intersection": "contested",
    "highway": "dense",
}
LEVEL, IDM = "stress", "idm"
COLUMNS = (
    *("world", "demand", "pairs", "policy", "an AV in a collision", "idm", "difference, pp", "p"),
    *("an AV caused one", "distance of all, m", "more than idm, m", "hard brakings of AVs", "idm"),
)
# What is taken away -> the constants of cosim.simulation.assistance without it.
PARTS: dict[str, dict[str, object]] = {
    "nothing": {},
    "the longer headway": {"HEADWAY": (0.8, 0.8)},
    "the use of the room ahead": {"CLOSES": (0.0, 0.0, 0.0)},
    "both": {"CLOSE": 0.0},
}


class Accelerate:
    """Asks every AV for more speed: what it does beyond is the car's own."""

    name = "accelerate"
    observation = ObservationConfig(maps=False)
    av_parameters: Mapping[str, str] = {}
    label = ""

    def reset(self, context: PolicyContext) -> None:
        """Nothing to remember."""

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """The same for all."""
        return {av: Decision(MetaAction.ACCELERATE) for av in histories}


class Without(Host):
    """A host whose cars lack a part of their answer."""

    def take_away(self, part: str) -> None:
        """One of `PARTS`."""
        from cosim.simulation import assistance  # libsumo: in the worker's process alone

        for name, value in PARTS[part].items():
            setattr(assistance, name, value)


def taken_away(episodes: int) -> list[str]:
    """Episodes with an AV in a collision, of AVs that always accelerate."""
    lines = [markdown_row(["taken away", *DEMAND, "together"]), markdown_row(["---"] * (len(DEMAND) + 2))]
    for part in PARTS:
        hits = []
        for world, demand in DEMAND.items():
            scenario = load(world, demand=[demand], preset=Preset.LAWFUL)
            scenario = vetted(replace(scenario, errors=levels()[LEVEL]))
            with Worker(Without, scenario, Accelerate(), math.radians(45.0)) as worker:
                worker.call("take_away", part)
                found: list[EpisodeResult] = [worker.call("run", s) for s in TUNING_SEEDS[:episodes]]
            hits.append(sum(any(c.involves_av for c in result.collisions) for result in found))
            print(part, world, hits[-1], flush=True)
        total = statistics.share(sum(hits), episodes * len(hits)).text(1, 100.0)
        lines.append(markdown_row([part, *map(str, hits), f"{sum(hits)}: {total} %"]))
    return lines


def rows_of(folder: Path, policy: str) -> dict[tuple[str, int], Row]:
    """(World, seed) -> row, of the demands of `DEMAND`."""
    return {
        (str(row["scenario"]), int(row["seed"])): row
        for row in run_folder.read(folder).rows
        if (row["policy"], row["errors"], row["status"]) == (policy, LEVEL, OK)
        and row["demand"] == DEMAND[str(row["scenario"])]
    }


def line(
    world: str, policy: str, own: Mapping[tuple[str, int], Row], idm: Mapping[tuple[str, int], Row]
) -> list[str]:
    """One world's cells, or of all together (""), paired by seed."""
    keys = sorted(key for key in own.keys() & idm.keys() if world in ("", key[0]))
    now, then = [own[key] for key in keys], [idm[key] for key in keys]

    def column(rows: list[Row], name: str) -> list[float]:
        return [float(row[name] or 0.0) for row in rows]

    hit, before = (np.array(column(rows, "av_involved_collisions")) > 0 for rows in (now, then))
    caused = sum(value > 0 for value in column(now, "av_caused_collisions"))
    way = [column(rows, "dt_mean_m") for rows in (now, then)]
    hard = [float(np.mean(column(rows, "hard_brakings_av"))) for rows in (now, then)]
    return [
        *(world or "together", DEMAND.get(world, ""), str(len(keys)), policy),
        *(_counted(int(hit.sum()), len(keys)), _counted(int(before.sum()), len(keys))),
        statistics.paired_share(before, hit).text(1, 100.0),
        f"{statistics.mcnemar(*statistics.discordant(before, hit)):.2g}",
        _counted(caused, len(keys)),
        *(f"{np.mean(way[0]):.0f}", statistics.paired_mean(way[1], way[0]).text(0)),
        *(f"{hard[0]:.1f}", f"{hard[1]:.1f}"),
    ]


def _counted(hits: int, count: int) -> str:
    return f"{hits}: {statistics.share(hits, count).text(1, 100.0)} %"


def paired(policies: Sequence[str], episodes: int, runs: Path, workers: str) -> list[str]:
    """Drive what is missing; a line a world and policy, and one of all together."""
    seeds = f"{FIRST_TEST_SEED}:{FIRST_TEST_SEED + episodes}"
    wanted = [word for name in (IDM, *policies) for word in ("--policy", name)]
    for demand in dict.fromkeys(DEMAND.values()):
        worlds = [w for name, d in DEMAND.items() if d == demand for w in ("--scenario", name)]
        which = [*worlds, "--demand", demand, *wanted, "--preset", Preset.LAWFUL, "--errors", LEVEL]
        running = ["--seeds", seeds, "--resume", "--no-report", "--workers", workers]
        code = cosim(["evaluate", *which, *running, "--out", str(runs / demand)])
        if code:
            raise SystemExit(code)
    rows = {
        name: {key: row for d in set(DEMAND.values()) for key, row in rows_of(runs / d, name).items()}
        for name in (IDM, *policies)
    }
    lines = [markdown_row(COLUMNS), markdown_row(["---"] * len(COLUMNS))]
    for policy in policies:
        lines += [markdown_row(line(w, policy, rows[policy], rows[IDM])) for w in (*DEMAND, "")]
    return [f"Seeds {seeds}.", "", *lines]


def main() -> None:
    """Make one part of the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--taken-away", action="store_true")
    parser.add_argument("--episodes", type=int, default=None)
    parser.add_argument("--policy", nargs="+", default=["vfn-p"])
    parser.add_argument("--runs", type=Path, default=Path("runs/humans"), help="where episodes are kept")
    parser.add_argument("--workers", default="2")
    parser.add_argument("--page", type=Path, default=PAGE)
    args = parser.parse_args()
    if args.taken_away:
        lines = taken_away(args.episodes or 30)
        fill(args.page, "taken away", lines)
    else:
        lines = paired(args.policy, args.episodes or 400, args.runs, args.workers)
        fill(args.page, "paired", lines)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
