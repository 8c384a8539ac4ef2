"""What all pages have in common: the job's command line, its heading, its CSV and its pictures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure as Picture

from benchmarks.papers.agents import config
from benchmarks.papers.cost import Reckoning
from benchmarks.papers.driving import (
    Order,
    Results,
    Settings,
    add_arguments,
    drive,
    settings_of,
)
from benchmarks.tables import Line, write_csv, write_page
from cosim.errors import CosimError
from cosim.seeding import FIRST_TEST_SEED
from cosim.workers.tasks import OK
from policy.checkpoint import read_card

# First on every page that drives networks and in results/README.md.
SAID_FIRST = (
    "**The tables show networks of a demonstrator:** `vfn-p-demonstrated`, `vfn-demonstrated` and",
    "`vfn-p-egoistic` learned from a script (`docs/guides/training.md`) and do not use their maps, past or",
    "predicted: what a map shows changes none of their choices, or hardly one",
    "(`docs/results/attribution.md`, by `cosim bench attribution --policy vfn-p-demonstrated --scenario",
    "merge --demand contested --seeds 150000:150006 --out DIR`). So the first against the second does not",
    "measure what predicted maps are worth. What `vfn-p` and `vfn`, which learned from rewards alone and",
    "see other vehicles in their maps alone, were asked and show stands in `asked.md`. On real",
    "networks with signals the preset `unguarded` drives unlawfully, through red lights and faster than",
    "lanes allow.",
)
STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "cosim", "font.size": 9.0}  # equal figures, equal file


@dataclass(frozen=True)
class Job:
    """One table or figure: what it needs to be driven, and the page made of it."""

    name: str  # of the module, the page and the CSV
    title: str
    orders: Callable[[], list[Order]]
    write: Callable[[Results, Settings], None]
    package: str = "benchmarks.papers"  # where its module lies
    first: int = FIRST_TEST_SEED  # seed
    redrives: bool = False  # whether its page needs episodes driven once more

    @property
    def command(self) -> str:
        return f"python -m {self.package}.{self.name}"

    def make(self, settings: Settings) -> None:
        """Drive what is missing, then write the page with all there is.

        A page of which nothing could be driven is left as it was; where nothing is to be driven
        (`settings.held`), one that would lack an arm too.
        """
        settings = replace(settings, first=self.first)
        if settings.held and self.redrives:
            print(f"{self.name}: left as it is: its episodes are driven once more", file=sys.stderr)
            return
        results = drive(self.orders(), settings, self.name)
        if results.lacking and (settings.held or results.lacking == len(results.driven)):
            print(f"{self.name}: left as it is: {results.lacking} arms have no episode", file=sys.stderr)
            return
        self.write(results, settings)
        print(settings.out / f"{self.name}.md")

    def main(self) -> None:
        """The command line."""
        parser = argparse.ArgumentParser(prog=self.command, description=self.title)
        add_arguments(parser)
        args = parser.parse_args()
        run_jobs([self], settings_of(args), args.dry_run)


def run_jobs(jobs: Sequence[Job], settings: Settings, dry_run: bool = False) -> None:
    """One after the other; what a user did wrong ends it with one sentence and exit code 2."""
    try:
        if dry_run:
            _tell_cost(jobs, settings)
            return
        for job in jobs:
            job.make(settings)
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except KeyboardInterrupt:
        print("interrupted: the same command goes on", file=sys.stderr)
        raise SystemExit(130) from None


def heading(job: Job, results: Results, settings: Settings, *more: str) -> list[str]:
    """Title, what is said first of networks, command, what it rests on, and what is not there."""
    rows = [row for one in results.driven for row in one.rows]
    wrong = sum(row["status"] != OK for row in rows)
    command = f"Made by `{job.command}{settings.flags}`, resumable"
    weights = networks(results, settings)
    lines = [f"# {job.title}", "", *([*SAID_FIRST, ""] if weights else [])]
    lines += [f"{command}; figures in `data/{job.name}.csv`."]
    lines += [
        f"Preset `unguarded`, drivers `lc2013`, equal seeds from {settings.first:,} on. Rates with Wilson,",
        "means with bootstrap, differences of pairs with Tango's and bootstrap 95 % intervals; p: McNemar.",
        "In episodes counted as `not comparable` over 5 % of the vehicles found no room to enter; they are",
        "in all figures.",
        *more,
    ]
    if settings.held:
        lines += [
            "Of every arm as many episodes as were driven so far (n); pairs on the seeds that both have."
        ]
    if weights:
        lines += ["", *weights]
    if settings.untrained:
        lines += ["", "**Untrained networks: this page shows that the machinery works, and nothing else.**"]
    if settings.duration is not None:
        lines += ["", f"**Episodes cut to {settings.duration:g} s: not comparable with any other page.**"]
    if wrong:
        lines += ["", f"{wrong} of {len(rows)} episodes failed and are left out."]
    lines += [""]
    if results.absent:
        lines += ["Not run yet:", "", *(f"- {why}" for why in results.absent), ""]
    return lines


def networks(results: Results, settings: Settings) -> list[str]:
    """The weights that were driven: a line each."""
    lines: dict[str, None] = {}
    for one in results.driven:
        agent = one.order.agent
        file = config(agent, settings.untrained).vfn_weights if one.rows and agent.learned else None
        if file is not None and agent.led:
            card = read_card(file)
            after = card["measured"].get("iteration")
            planned = card["data"].get("training", {}).get("iterations")
            iteration = "" if after is None else f", iteration {after} of {planned or '?'}"
            name = agent.name if agent.weights else agent.base
            lines[f"- weights of `{name}`: SHA-256 {card['sha256'][:12]}{iteration}"] = None
    return list(lines)


def save(job: Job, settings: Settings, page: Sequence[str], lines: Sequence[Line]) -> None:
    """The page and the CSV."""
    data = settings.out / "data"
    data.mkdir(parents=True, exist_ok=True)
    write_csv(data / f"{job.name}.csv", lines)
    write_page(settings.out / f"{job.name}.md", page)


def drawing(width: float, height: float) -> Picture:
    """An empty picture; sizes in inches."""
    return Picture(figsize=(width, height), layout="constrained")


def save_picture(picture: Picture, path: Path) -> str:
    """Write it as SVG; the Markdown that shows it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with rc_context(STYLE):
        picture.savefig(path, metadata={"Date": None, "Creator": None})
    return f"![{path.stem}]({path.name})"


# ---- inside ----


def _tell_cost(jobs: Sequence[Job], settings: Settings) -> None:
    """A line per agent and page, and their sum."""
    reckoning = Reckoning()
    all_episodes, all_hours = 0, 0.0
    for job in jobs:
        found = reckoning.left(job.name, job.orders(), replace(settings, first=job.first))
        for one in found:
            cost = "? (no short episode came through)" if one.hours is None else f"{one.hours:.2f}"
            print(f"{job.name}: {one.agent}: {one.episodes} episodes, {cost} CPU hours")
        episodes, hours = sum(one.episodes for one in found), sum(one.hours or 0.0 for one in found)
        print(f"{job.name}: {episodes} episodes, {hours:.1f} CPU hours", flush=True)
        all_episodes, all_hours = all_episodes + episodes, all_hours + hours
    if len(jobs) > 1:
        print(
            f"all: {all_episodes} episodes, {all_hours:.1f} CPU hours (those that pages share counted once)"
        )
