"""Compliance of AVs with traffic rules in the networks of tests/worlds, by figures and SUMO's outputs.

    python -m benchmarks.law [--worlds arterial ...] [--arms NAME ...] [--seeds 3] [--preset lawful] [--show]
    python -m benchmarks.law --page --seeds 20

The first prints a table per network, on seeds from 100,000; with `--errors LEVEL` also the collisions
compared with `idm`. The second writes docs/results/law.md, on seeds from 310,000. The baseline `idm` is
always driven too, since targets refer to it. The independent checker is tests/law/checker.py. With --runs
DIR finished episodes are kept, and the same command resumes.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.batch.episode_runner import EpisodeRunner
from cosim.report import statistics
from cosim.scenario import Scenario
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.vet import vetted
from cosim.types import Preset
from cosim.workers import tasks
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import Progress
from cosim.workers.tasks import Task
from tests.law import checker
from tests.worlds.build import NAMES, build

VALIDATION, PAGE = 100_000, 310_000  # first seeds
PAGE_FILE = Path("docs/results/law.md")
DETAILS = ("interventions", "blocked", "persons", "figures agree")  # columns that the page leaves out
IDM = "idm"
ARMS = ("car-alone", "random")  # without networks, since the lawful car is under test
FREE = ("random",)  # arms without targets for distance, trips and braking
SHARES = (0.2, 1.0)  # of AVs
NOTES = {  # arm -> explanation on the page
    IDM: "In `idm` SUMO's driver drives every AV; targets are relative to it.",
    "car-alone": "The agent of `car-alone` asks the car for more speed at every decision.",
    "random": "The agent of `random` asks the car for a random action at every decision.",
}
FIGURES = (  # of the rows, beside the checker's counts
    *("red_light_violations", "stop_sign_violations", "right_of_way_violations", "speeding_share"),
    *("worst_speeding_mps", "junctions_blocked", "avs_stuck", "av_trips_completed", "person_conflicts"),
    *("interventions", "av_involved_collisions", "av_caused_collisions", "hard_brakings_av", "dt_mean_m"),
)
Row = dict[str, Any]


@dataclass(frozen=True)
class Case(EpisodeOptions):
    """An episode with floating-car data of every simulation step."""

    def scenario(self, options: Sequence[str] = ()) -> Scenario:
        """The scenario with the options of the checker."""
        words = [word for name, value in checker.OPTIONS.items() for word in (f"--{name}", value)]
        return super().scenario((*words, *options))


class Checked(EpisodeRunner):
    """Hosted by the engine: drives an episode and checks SUMO's outputs in the same process."""

    def run(  # type: ignore[override]
        self, case: Case, warnings: tuple[str, ...], keep: str | None, progress: tasks.Progress
    ) -> Row:
        """The row: `law` has the checker's counts, `figures` the document's. `keep`: folder for outputs."""
        host = self.open(case, warnings)
        with tempfile.TemporaryDirectory(prefix="cosim-law-") as scratch:
            folder = Path(scratch) if keep is None else Path(keep) / case.key
            document = host.run(case.seed, progress, outputs=checker.OUTPUTS, folder=folder).document()
            law = checker.check(host.episode.scenario.net, folder)
        return {
            "world": Path(case.what).stem,
            "arm": case.policy,
            "penetration": case.penetration,
            "seed": case.seed,
            "law": asdict(law),
            "figures": {name: document.get(name) for name in FIGURES},
            "boxes": sum(c["source"] == "box" for c in document["collision_list"]),  # not reported by SUMO
            "ended": document["steps"] * host.episode.scenario.timing.decision,
            "seconds": sum(document["timings"].values()) if document["timings"] else None,
        }


def cases(
    worlds: Mapping[str, Path],
    arms: Sequence[str],
    shares: Sequence[float],
    seeds: range,
    preset: str,
    errors: str | None = None,
) -> list[Case]:
    """Every episode, `idm` first."""
    return [
        Case(str(worlds[world]), policy=arm, seed=seed, penetration=share, preset=preset, errors=errors)
        for world, share, arm, seed in itertools.product(worlds, shares, dict.fromkeys((IDM, *arms)), seeds)
    ]


def driven(todo: Sequence[Case], workers: int, runs: Path | None, keep: Path | None) -> list[Row]:
    """The rows of all cases; those in `runs` are not driven again."""
    names = {case.key: f"{Path(case.what).stem}-{case.key}" for case in todo}  # independent of folders
    held: dict[str, Row] = {}
    if runs is not None and runs.is_file():
        held = {row["key"]: row for row in map(json.loads, runs.read_text().splitlines())}
    warned = {(c.what, c.penetration): vetted(c.scenario()).warnings for c in todo}
    work = [
        Task(case.key, case.cell, (case, warned[case.what, case.penetration], keep and str(keep)))
        for case in todo
        if names[case.key] not in held
    ]
    with (
        Progress("law", "episodes") as progress,
        closing(LocalEngine(Checked, workers=workers).run(work)) as all_,
    ):
        for number, outcome in enumerate(all_, 1):
            progress(number, len(work))
            if not outcome.ok:
                case = next(case for case in todo if case.key == outcome.key)
                where = f"{Path(case.what).stem}, {case.policy}, {case.penetration:.0%}, seed {case.seed}"
                raise SystemExit(f"error: {where}: {outcome.error}\n{outcome.stderr or ''}")
            row = outcome.value | {"key": names[outcome.key]}
            held[row["key"]] = row
            if runs is not None:
                runs.parent.mkdir(parents=True, exist_ok=True)
                with runs.open("a") as file:
                    file.write(json.dumps(row, default=float) + "\n")
    return [held[names[case.key]] for case in todo]


@dataclass(frozen=True)
class Cell:
    """The results of one arm in one network at one share of AVs."""

    rows: list[Row]

    def total(self, name: str) -> float:
        """Sum over all episodes of a count of the checker."""
        return float(sum(row["law"][name] for row in self.rows))

    def figure(self, name: str) -> float | None:
        """Sum over all episodes of a figure of the rows."""
        known = [row["figures"][name] for row in self.rows if row["figures"].get(name) is not None]
        return float(sum(known)) if known else None

    def rate(self, name: str) -> str:
        """Events per episode with the interval; "0" without events."""
        count = int(self.total(name))
        return "0" if not count else f"{count}: {statistics.rate(count, len(self.rows)).text(2)}"


def _columns(cell: Cell, idm: Cell, free: bool) -> dict[str, tuple[str, bool | None]]:
    """Column -> text of a cell, and whether its target is met, given idm's cell (None: no target)."""
    episodes = len(cell.rows)
    worst = max(row["law"]["worst_speeding_mps"] for row in cell.rows)
    over = int(cell.total("speeding_steps"))
    hits, caused = (int(cell.figure(f"av_{name}_collisions") or 0) for name in ("involved", "caused"))
    trips, wanted = cell.total("av_trips_completed"), idm.total("av_trips_completed")
    distance, other = cell.total("distance_mean_m") / episodes, idm.total("distance_mean_m") / episodes
    hard, allowed = cell.total("hard_brakings_av"), idm.total("hard_brakings_av")
    targeted = None if free else True
    return {
        "red": (cell.rate("red_light_violations"), not cell.total("red_light_violations")),
        "stop": (cell.rate("stop_sign_violations"), not cell.total("stop_sign_violations")),
        "right of way": (
            cell.rate("right_of_way_violations"),
            cell.total("right_of_way_violations") <= idm.total("right_of_way_violations"),
        ),
        "steps too fast (worst)": (f"{over} ({worst:+.1f} m/s)", not over),
        "AV collisions (caused)": (f"{hits} ({caused})", not caused),
        "stuck": (cell.rate("avs_stuck"), not cell.total("avs_stuck")),
        "AV trips": (f"{trips:.0f} of {wanted:.0f}", targeted and trips >= 0.95 * wanted),
        "distance of all": (f"{distance:.0f} of {other:.0f} m", targeted and distance >= 0.95 * other),
        "hard brakings (figure)": (
            f"{hard:.0f} to {allowed:.0f} ({_plain(cell.figure('hard_brakings_av'))})",
            targeted and hard <= max(2.0 * allowed, 0.5 * episodes),
        ),
        "interventions": (_plain(cell.figure("interventions")), None),
        "blocked": (_plain(cell.figure("junctions_blocked")), None),
        "persons": (_plain(cell.figure("person_conflicts")), None),
        "figures agree": _agreement(cell),
    }


COUNTED_TWICE = (
    *("red_light_violations", "stop_sign_violations", "right_of_way_violations"),
    *("avs_stuck", "av_trips_completed", "av_involved_collisions", "worst_speeding_mps"),
)


def differences(row: Row) -> dict[str, tuple[float, float]]:
    """Figure -> (the checker's count, the row's) for differing figures.

    Differences due to collisions that SUMO does not report are ignored.
    """
    law, figures = row["law"], row["figures"]
    by_collision = ("right_of_way_violations", "av_involved_collisions", "av_trips_completed")
    law = law | {"worst_speeding_mps": law["worst_speeding_in_frames_mps"]}
    return {
        name: (law[name], figures[name])
        for name in COUNTED_TWICE
        if figures.get(name) is not None
        and abs(law[name] - figures[name]) > 1e-3
        and not (row["boxes"] and name in by_collision)
    }


def _agreement(cell: Cell) -> tuple[str, bool | None]:
    names = sorted({name for row in cell.rows for name in differences(row)})
    if all(cell.figure(name) is None for name in COUNTED_TWICE[:1]):
        return "-", None
    return ("no: " + ", ".join(names) if names else "yes"), None


def table(world: str, cells: Mapping[tuple[float, str], Cell]) -> list[str]:
    """The table of one network: one line per arm and share; missed targets are bold."""
    lines: list[str] = []
    for (share, arm), cell in cells.items():
        columns = _columns(cell, cells[share, IDM], arm in FREE)
        if not lines:
            lines = [f"## {world}", "", markdown_row(["AVs", "arm", *columns, "targets"])]
            lines.append("|---" * (len(columns) + 3) + "|")
        missed = _missed(cell, cells[share, IDM], arm)
        verdict = "-" if arm == IDM else f"missed: {', '.join(missed)}" if missed else "met"
        shown = [f"**{text}**" if holds is False and arm != IDM else text for text, holds in columns.values()]
        lines.append(markdown_row([f"{share:.0%}", arm, *shown, verdict]))
    return [*lines, ""]


def tables(rows: Sequence[Row]) -> list[str]:
    """The tables of all networks."""
    lines: list[str] = []
    for world in dict.fromkeys(row["world"] for row in rows):
        lines += table(world, _cells(rows, world))
    return lines


def shown(rows: Sequence[Row]) -> list[str]:
    """All violations of all episodes, and differences between figures and checker."""
    lines = []
    for row in rows:
        where = f"{row['world']} {row['arm']} {row['penetration']:.0%} {row['seed']}"
        lines += [
            f"{where}: {v['time']:g} s {v['kind']} {v['vehicle']} {v['link']} {v['what']}"
            for v in row["law"]["violations"]
        ]
        for name, (counted, figure) in differences(row).items():
            lines.append(f"{where}: {name}: the checker counts {counted:g}, the figure is {figure:g}")
    return lines


def beside_idm(rows: Sequence[Row]) -> list[str]:
    """Markdown: episodes with an AV in a collision, paired with `idm`'s, per network and for all."""
    head = ["world", "AVs", "arm", "pairs", "an AV in a collision", "of `idm`", "difference, pp", "p"]
    head += ["caused by an AV", "of `idm`", "distance of all, difference in m"]
    lines = [markdown_row(head), markdown_row(["---"] * len(head))]
    at = {(row["world"], row["penetration"], row["arm"], row["seed"]): row["figures"] for row in rows}
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    arms = dict.fromkeys((row["penetration"], row["arm"]) for row in rows if row["arm"] != IDM)
    among = [[world] for world in worlds] + ([worlds] if len(worlds) > 1 else [])
    return lines + [_paired(at, share, arm, some) for some in among for share, arm in arms]


def _paired(at: Mapping[tuple[Any, ...], Row], share: float, arm: str, worlds: Sequence[str]) -> str:
    keys = [key for key in at if key[0] in worlds and key[1:3] == (share, arm)]
    now, then = [at[key] for key in keys], [at[*key[:2], IDM, key[3]] for key in keys]
    before_m, now_m = ([float(row["dt_mean_m"]) for row in rows] for rows in (then, now))
    return markdown_row(
        [
            *(worlds[0] if len(worlds) == 1 else "together", f"{share:.0%}", arm, str(len(keys))),
            *in_collisions(now, then),
            *(str(sum(bool(row["av_caused_collisions"]) for row in rows)) for rows in (now, then)),
            statistics.paired_mean(before_m, now_m).text(1),
        ]
    )


def in_collisions(now: Sequence[Row], then: Sequence[Row]) -> list[str]:
    """Cells: episodes with an AV in a collision, those of `then`, the paired difference, p."""
    hit, before = (np.array([bool(row["av_involved_collisions"]) for row in rows]) for rows in (now, then))
    shares = (statistics.share(int(side.sum()), len(side)).text(1, 100.0) for side in (hit, before))
    return [
        *(f"{share} %" for share in shares),
        statistics.paired_share(before, hit).text(1, 100.0),
        f"{statistics.mcnemar(*statistics.discordant(before, hit)):.2g}",
    ]


def page(rows: Sequence[Row], preset: str, seeds: range, command: str) -> list[str]:
    """docs/results/law.md: all networks together, and the missed targets."""
    networks = list(dict.fromkeys(row["world"] for row in rows))
    of_each = {(world, *key): cell for world in networks for key, cell in _cells(rows, world).items()}
    missed = [
        f"- {world}, {share:.0%}, `{arm}`: {', '.join(found)}"
        for (world, share, arm), cell in of_each.items()
        if arm != IDM and (found := _missed(cell, of_each[world, share, IDM], arm))
    ]
    judged = sum(arm != IDM for _, _, arm in of_each)
    return [
        "# Does the lawful car keep the law?",
        "",
        f"**{'No' if missed else 'Yes'}.** {judged - len(missed)} of {judged} cases meet every target.",
        "A case is a network, a share of AVs and an agent.",
        "",
        *_summary(_cells(rows)),
        "",
        *([*missed, ""] if missed else []),
        "## Conditions",
        "",
        f"{len(networks)} networks of tests/worlds, preset `{preset}`, {len(seeds)} seeds from",
        f"{seeds.start:,}.",
        *(NOTES[arm] for arm in dict.fromkeys(row["arm"] for row in rows) if arm in NOTES),
        "",
        "tests/law/checker.py counts violations in SUMO's outputs and shares no code with the simulation.",
        "Counts are events of AVs, with events per episode and the exact Poisson 95 % interval. Targets: no",
        "red light, no stop sign, no step above the limit by more than 1 m/s, no collision caused by an AV,",
        "no AV stuck, and at most as many failures to yield as `idm`. Agents other than `random` also need",
        "95 % of `idm`'s trips and distance, and at most twice its hard brakings. In pairs of figures the",
        "second is that of `idm`.",
        "Collisions are cosim's figure, which has overlaps that SUMO does not report.",
        "",
        "```",
        command,
        "```",
    ]


def _cells(rows: Sequence[Row], world: str | None = None) -> dict[tuple[float, str], Cell]:
    """(Share of AVs, arm) -> rows in this network; None: in all networks together."""
    found: dict[tuple[float, str], list[Row]] = {}
    for row in rows:
        if world in (None, row["world"]):
            found.setdefault((row["penetration"], row["arm"]), []).append(row)
    return {key: Cell(of) for key, of in sorted(found.items(), key=lambda item: item[0][0])}


def _missed(cell: Cell, idm: Cell, arm: str) -> list[str]:
    """The columns with a missed target."""
    return [name for name, (_, holds) in _columns(cell, idm, arm in FREE).items() if holds is False]


def _summary(cells: Mapping[tuple[float, str], Cell]) -> list[str]:
    """The table of all networks together: one line per arm and share, without targets."""
    lines: list[str] = []
    for (share, arm), cell in cells.items():
        columns = _columns(cell, cells[share, IDM], arm in FREE)
        shown = {name: text for name, (text, _) in columns.items() if name not in DETAILS}
        if not lines:
            lines = markdown_head(["AVs", "agent", *shown])
        lines.append(markdown_row([f"{share:.0%}", arm, *shown.values()]))
    return lines


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.law",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--worlds", nargs="+", choices=NAMES, default=list(NAMES), metavar="NAME", help=", ".join(NAMES))
    add("--arms", nargs="+", default=list(ARMS), metavar="POLICY", help=f"beside idm; {' '.join(ARMS)}")
    add("--penetration", nargs="+", type=float, default=list(SHARES), metavar="X", help="share of AVs")
    add("--seeds", type=int, default=3, metavar="N", help="number of seeds")
    add("--first", type=int, metavar="SEED", help=f"first seed: default {VALIDATION}, with --page {PAGE}")
    add("--preset", choices=Preset.ALL, default=Preset.LAWFUL)
    add("--errors", metavar="LEVEL", help="human errors (default: none)")
    add("--workers", type=int, default=2, metavar="N")
    add("--runs", type=Path, metavar="DIR", help="keep the rows there, and continue from them")
    add("--keep", type=Path, metavar="DIR", help="keep SUMO's outputs there")
    add("--show", action="store_true", help="list every violation")
    add("--page", action="store_true", help="write the page")
    add("--out", type=Path, metavar="FILE.md", help=f"default {PAGE_FILE}")
    args = parser.parse_args(arguments)
    first = args.first or (PAGE if args.page else VALIDATION)
    seeds = range(first, first + args.seeds)
    place = args.runs or Path(tempfile.mkdtemp(prefix="cosim-law-"))
    began = time.perf_counter()
    worlds = build(place / "worlds", args.worlds)
    todo = cases(worlds, args.arms, args.penetration, seeds, args.preset, args.errors)
    rows = driven(todo, args.workers, args.runs and args.runs / "episodes.jsonl", args.keep)
    if args.show:
        print("\n".join(shown(rows)))
    if args.page:
        command = f"python -m benchmarks.law --page --seeds {args.seeds}"
        command += "" if args.preset == Preset.LAWFUL else f" --preset {args.preset}"
        command += f" --errors {args.errors}" if args.errors else ""
        command += "" if args.arms == [*ARMS] else f" --arms {' '.join(args.arms)}"
        out = args.out or PAGE_FILE
        write_page(out, page(rows, args.preset, seeds, command))
        print(out)
    else:
        print("\n".join([*tables(rows), *(beside_idm(rows) if args.errors else [])]))
        print(f"{len(rows)} episodes, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
