"""T's figure 8: three sample episodes of the guide AV, with speed profiles and pictures, found among many.

    python -m benchmarks.papers.t_figure8 [--scale 1] [--dry-run]

Every episode is driven once more, recorded and sorted by what its guide AV did
(`benchmarks.papers.guide`); the first of each kind is shown, with the number of episodes of each kind. It
takes as long as driving did.
"""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from benchmarks.papers.agents import Agent
from benchmarks.papers.claims import VFN_P
from benchmarks.papers.driving import (
    SVO,
    Driven,
    Order,
    Results,
    Settings,
    planned,
)
from benchmarks.papers.guide import (
    BEFORE,
    KINDS,
    OTHER,
    OVERTAKES,
    SHOWN,
    SLOWER,
    SLOWS,
    YIELDS,
    GuideRunner,
)
from benchmarks.papers.pages import Job, drawing, heading, save, save_picture
from benchmarks.tables import Line, markdown_row
from cosim.batch.folder import RunFolder
from cosim.errors import CosimError
from cosim.files import whole
from cosim.report.statistics import share
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import Progress
from cosim.workers.tasks import OK, Task

FOLDER = "guide"  # in settings.runs
AGENTS = (VFN_P, "altruist-rule")  # the learned altruist, and what a scripted one does
# demand and HVs; T's is the first. In most dense episodes no AV is near where the mission vehicle merges
TRAFFIC = {("contested", "moderate"): 100, ("dense", "mixed"): 300}
WANTED = (SLOWS, YIELDS, OVERTAKES)  # T's three samples, from left to right
GuideRow = Mapping[str, Any]  # `GuideRunner.run`, and the seed


def orders() -> list[Order]:
    """The merge: contested, where nobody can pass to the left, and dense, where somebody may."""
    return [
        Order(Agent(name), "merge", *traffic, episodes, SVO)
        for traffic, episodes in TRAFFIC.items()
        for name in AGENTS
    ]


def write(results: Results, settings: Settings) -> None:
    """t_figure8.md, pictures of every sample, data/t_figure8.csv; drives what was not recorded yet."""
    page = [
        *heading(JOB, results, settings, "World `merge`, phi 45 degrees."),
        "The guide AV is the one nearest to the merging vehicle when it merges, of those that perceive it",
        f"and drove in the lane it merges into within the {BEFORE:g} s before. It made room if it lost",
        f"{SLOWER:g} m/s or more in that time, or moved to the left. Every picture is 200 m wide.",
        f'"{OTHER}": it merged, and nobody had to make room.',
        "",
    ]
    lines: list[Line] = []
    found = guide_rows([one for one in results.driven if one.rows], settings)
    for traffic in TRAFFIC:
        here = {one.name: seen for one, seen in found if (one.order.demand, one.order.behavior) == traffic}
        if here:
            page += _counted(", ".join(traffic), here, lines)
    for name in dict.fromkeys(one.name for one, _ in found):
        mine = [(one.order, episode) for one, seen in found if one.name == name for episode in seen]
        for kind in WANTED:
            page += [f"## {name}: {kind}", ""]
            first = next((found for found in mine if found[1]["guided"]["kind"] == kind), None)
            page += _sample(name, kind, *first, settings) if first else [f"None of {len(mine)} episodes."]
            page += [""]
    save(JOB, settings, page, lines)


def guide_rows(driven: Sequence[Driven], settings: Settings) -> list[tuple[Driven, list[GuideRow]]]:
    """Every episode that came through once more, recorded: a small file each, in settings.runs/guide.

    Raises CosimError when one is not the same again.
    """
    work = planned([one.order for one in driven], settings)
    hashes = {row["key"]: row["trace_hash"] for one in driven for row in one.rows if row["status"] == OK}
    folder = settings.runs / FOLDER
    with RunFolder(str(folder), resume=True, episodes=0):
        todo = [
            cell.task(case)
            for cell, case in work.cases()
            if case.key in hashes and not (folder / f"{case.key}.json").exists()
        ]
        engine = LocalEngine(GuideRunner, (work.agents, settings.untrained), workers=settings.workers)
        _drive(todo, folder, engine, hashes)
        return [(one, _kept(folder, one)) for one in driven]


def _kept(folder: Path, one: Driven) -> list[GuideRow]:
    """The recorded episodes of one arm, by seed."""
    files = [folder / f"{row['key']}.json" for row in one.rows]
    return [json.loads(file.read_text()) for file in files if file.exists()]


def _counted(traffic: str, found: Mapping[str, list[GuideRow]], lines: list[Line]) -> list[str]:
    """How many episodes of each kind; rates with their intervals into `lines`."""
    heads = ["", *KINDS, "did not merge", "episodes"]
    page = [f"## {traffic}", "", markdown_row(heads), "|---" * len(heads) + "|"]
    for name, episodes in found.items():
        cells = []
        merged = [e for e in episodes if e["guided"]["merged"] is not None]
        groups = {kind: sum(e["guided"]["kind"] == kind for e in merged) for kind in KINDS}
        groups["did not merge"] = len(episodes) - len(merged)
        for kind, hits in groups.items():
            figure = share(hits, len(episodes))
            cells.append(f"{hits} = {figure.text(0, 100.0)} %" if figure.known else "-")
            values = (figure.value, figure.low, figure.high, len(episodes), 0, None)
            lines.append(Line(traffic, "merge", name, "", kind, "share", *values))
        page.append(markdown_row([name, *cells, str(len(episodes))]))
    return [*page, ""]


def _sample(name: str, kind: str, order: Order, episode: GuideRow, settings: Settings) -> list[str]:
    """Speed profiles of the guide AV and of the merging vehicle, and the road at three moments."""
    g = episode["guided"]
    stem = f"t_figure8-{name.split(' (')[0]}-{WANTED.index(kind) + 1}"
    picture = drawing(7.6, 2.6)
    axes = picture.subplots()
    for vehicle, values, colour in (
        (f"guide AV {g['guide']}", g["guide_speed"], "tab:orange"),
        (f"merging vehicle {g['mission']}", g["mission_speed"], "tab:purple"),
    ):
        points = [(t, v) for t, v in zip(g["times"], values, strict=True) if v is not None]
        axes.plot(*zip(*points, strict=True), color=colour, label=vehicle)
    axes.axvline(0.0, color="0.5", linewidth=0.8)
    axes.set(xlabel="s from the merge", ylabel="speed, m/s")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    page = [
        f"`{order.demand}`, {order.behavior} HVs, seed {episode['seed']}, trace hash"
        f" `{episode['trace_hash'][:16]}`; merged {g['merged']:.1f} s after the episode began."
    ]
    page += ["", save_picture(picture, settings.out / f"{stem}.svg"), ""]
    for k, (png, shift) in enumerate(zip(episode["pictures"], SHOWN, strict=False)):
        file = settings.out / f"{stem}-{k + 1}.png"
        file.write_bytes(base64.b64decode(png))
        page += [f"{shift:+g} s:", "", f"![{shift:+g} s]({file.name})", ""]
    return page


def _drive(todo: Sequence[Task], folder: Path, engine: LocalEngine, hashes: Mapping[str, str]) -> None:
    """Each episode into a file of its own, whole or not at all; what fails is tried again next time."""
    progress = Progress("t_figure8, driven once more", "episodes")
    try:
        with closing(engine.run(todo)) as outcomes:
            for k, outcome in enumerate(outcomes):
                progress(k + 1, len(todo))
                if not outcome.ok:
                    print(f"t_figure8: {outcome.key}: {outcome.error or outcome.stderr}", file=sys.stderr)
                    continue
                if outcome.value["trace_hash"] != hashes[outcome.key]:
                    raise CosimError(f"{outcome.key}: driven once more, the episode is not the same")
                pictures = [base64.b64encode(png).decode() for png in outcome.value["pictures"]]
                with whole(folder / f"{outcome.key}.json") as draft:
                    draft.write_text(json.dumps({**outcome.value, "pictures": pictures}))
    finally:
        progress.done()


JOB = Job("t_figure8", "Figure 8 of T: what the guide AV does", orders, write, redrives=True)

if __name__ == "__main__":
    JOB.main()
