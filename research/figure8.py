"""T's figure 8: how an AV makes room for the merging vehicle, in sample episodes.

    python -m research.figure8 [--workers 2] [--runs DIR] [--out DIR]

The altruists of the claim `t_figures` drive the merge and are recorded. Each episode is classified by the
maneuver of its guide AV (`research.guide`). The page shows the number of each kind and its first episode. An
interrupted run continues with the same command.
"""

from __future__ import annotations

import argparse
import base64
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure as Picture

from cosim.batch.folder import RunFolder
from cosim.errors import CosimError
from cosim.files import whole
from cosim.report.statistics import share
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import Progress
from cosim.workers.tasks import Task
from research import cli, drive, page, picture, schema
from research.drive import Arm, Settings
from research.evaluate import Line
from research.guide import (
    KINDS,
    LOOKBACK,
    MIN_SLOWING,
    OTHER,
    OVERTAKES,
    PICTURE_TIMES,
    SLOWS,
    YIELDS,
    GuideRunner,
)
from research.schema import Condition

NAME, CLAIM, SCENARIO = "t_figure8", "t_figures", "merge"
ARMS = ("altruist", "altruist-rule")  # the learned altruist, and a scripted one
FOLDER = "guide"  # in the folder of runs, with one small file per episode
MAX_EPISODES = 100  # per arm and demand
SAMPLES = (SLOWS, YIELDS, OVERTAKES)  # T's three samples, from left to right
TITLE = "# Figure 8 of T: how an AV makes room"
HEADING = f"""\
The guide AV is the AV nearest to the merging vehicle at the moment of the merge. Only AVs count that
perceive the merging vehicle and drove in its target lane within the {LOOKBACK:g} s before. The guide
AV made room if it slowed by {MIN_SLOWING:g} m/s or more in that time, or moved to the left. Every
picture is 200 m wide. "{OTHER}": the vehicle merged, and no AV had to make room.
"""
GuideRow = Mapping[str, Any]  # of `GuideRunner.run`
Found = Mapping[tuple[Condition, str], tuple[Arm, list[GuideRow]]]


def record(settings: Settings) -> Found:
    """Every episode, recorded now or read from its file. The next run tries failed episodes again.

    Raises BadInput and CosimError as `research.drive.drive`.
    """
    (claim,) = schema.chosen([CLAIM])
    work = drive.planned([claim], settings)
    arms = {
        key: arm
        for key, arm in work.arms[CLAIM].items()
        if key[0].scenario == SCENARIO and key[1] in ARMS and (settings.untrained or not arm.label)
    }
    folder = settings.runs / FOLDER
    with RunFolder(str(folder), resume=True, episodes=0):
        cases = [
            (arm.cell, arm.cell.case.with_seed(seed))
            for arm in arms.values()
            for seed in arm.seeds[:MAX_EPISODES]
        ]
        _drive(
            [cell.task(case) for cell, case in cases if not _file(folder, case.key).exists()],
            folder,
            settings,
        )
        return {key: (arm, _kept(folder, arm)) for key, arm in arms.items()}


def write(found: Found, settings: Settings, out: Path) -> Path:
    """t_figure8.md, pictures of every sample, data/t_figure8.csv; returns the page."""
    answers, samples, rows = list[str](), list[str](), list[Line]()
    for name in dict.fromkeys(name for _, name in found):
        mine = [(c, arm, row) for (c, other), (arm, seen) in found.items() if other == name for row in seen]
        made = sum(row["guided"]["kind"] in SAMPLES for _, _, row in mine)
        answers.append(f"An AV made room in {made} of {len(mine)} episodes of `{name}`.")
        for number, kind in enumerate(SAMPLES, 1):
            first = next((one for one in mine if one[2]["guided"]["kind"] == kind), None)
            if first:
                samples += [f"## {name}: {kind}", "", *_sample(f"{name}-{number}", *first, out), ""]
    lines = [TITLE, "", *page.wrapped(" ".join(answers)), "", HEADING]
    for condition in dict.fromkeys(condition for condition, _ in found):
        lines += _counted(condition, found, rows)
    lines += samples
    lines += [
        f"Made by `python -m research.figure8{page.flags(settings)}`; figures in `data/{NAME}.csv`.",
        "",
    ]
    page.write_csv(out / "data" / f"{NAME}.csv", rows)
    with whole(out / f"{NAME}.md") as draft:
        draft.write_text("\n".join(lines), encoding="utf-8")
    return out / f"{NAME}.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code: 0; 2 the claim is invalid; 4 the drives cannot continue."""
    parser = argparse.ArgumentParser(prog="python -m research.figure8", description=__doc__)
    cli.add_flags(parser)
    args = parser.parse_args(arguments)
    settings = cli.settings_of(args)
    try:
        found = record(settings)
    except CosimError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    if not any(rows for _, rows in found.values()):
        print(f"{NAME}: page unchanged: no episode was driven", file=sys.stderr)
        return 0
    print(write(found, settings, args.out))
    return 0


# ---- inside ----


def _file(folder: Path, key: str) -> Path:
    return folder / f"{key}.json"


def _kept(folder: Path, arm: Arm) -> list[GuideRow]:
    """The recorded episodes of one arm, by seed."""
    files = [_file(folder, arm.cell.case.with_seed(seed).key) for seed in arm.seeds[:MAX_EPISODES]]
    return [json.loads(file.read_text()) for file in files if file.exists()]


def _counted(condition: Condition, found: Found, lines: list[Line]) -> list[str]:
    """The table of episodes by kind; appends their shares with intervals to `lines`."""
    heads = ["", "weights", *KINDS, "did not merge", "episodes"]
    rows = [heads, ["---"] * len(heads)]
    for (other, name), (arm, episodes) in found.items():
        if other != condition or not episodes:
            continue
        merged = [e for e in episodes if e["guided"]["merged"] is not None]
        counts = {kind: sum(e["guided"]["kind"] == kind for e in merged) for kind in KINDS}
        counts["did not merge"] = len(episodes) - len(merged)
        figures = {kind: share(hits, len(episodes)) for kind, hits in counts.items()}
        for kind, figure in figures.items():
            line = Line(
                *(SCENARIO, condition.text, name, "", kind, "share"),
                *(figure.value, figure.low, figure.high, len(episodes), 0),
            )
            lines.append(
                line._replace(policy=drive.policy(arm.cell), weights=arm.weights, definitions=arm.definitions)
            )
        cells = [f"{figure.text(0, 100.0)} %" for figure in figures.values()]
        rows.append([name, arm.weights or "-", *cells, str(len(episodes))])
    return [f"## {condition.text}", "", *(f"| {' | '.join(row)} |" for row in rows), ""]


def _sample(stem: str, condition: Condition, arm: Arm, episode: GuideRow, out: Path) -> list[str]:
    """Speed profiles of the guide AV and of the merging vehicle, and the road at three moments."""
    g, stem = episode["guided"], f"{NAME}-{stem}"
    drawn = Picture(figsize=(7.6, 2.6), layout="constrained")
    axes = drawn.subplots()
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
    picture.save(drawn, out / f"{stem}.svg")
    behavior = arm.cell.scenario.behavior
    lines = [
        f"{condition.text}, {behavior} HVs, seed {episode['seed']}, trace hash",
        f"`{episode['trace_hash'][:16]}`; merged {g['merged']:.1f} s after the episode began.",
        *("", f"![speeds]({stem}.svg)", ""),
    ]
    for k, (png, shift) in enumerate(zip(episode["pictures"], PICTURE_TIMES, strict=False)):
        file = out / f"{stem}-{k + 1}.png"
        file.write_bytes(base64.b64decode(png))
        lines += [f"{shift:+g} s:", "", f"![{shift:+g} s]({file.name})", ""]
    return lines


def _drive(todo: Sequence[Task], folder: Path, settings: Settings) -> None:
    """Drive the tasks; write each episode atomically to a file of its own."""
    engine = LocalEngine(GuideRunner, workers=settings.workers)
    with Progress(NAME, "episodes") as progress, closing(engine.run(todo)) as outcomes:
        for k, outcome in enumerate(outcomes, 1):
            progress(k, len(todo))
            if not outcome.ok:
                print(f"{NAME}: {outcome.key}: {outcome.error or outcome.stderr}", file=sys.stderr)
                continue
            pictures = [base64.b64encode(png).decode() for png in outcome.value["pictures"]]
            with whole(_file(folder, outcome.key)) as draft:
                draft.write_text(json.dumps({**outcome.value, "pictures": pictures}))


if __name__ == "__main__":
    raise SystemExit(main())
