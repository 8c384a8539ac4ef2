"""Puts the report together: verdict, tables, plots, worst episodes, failures, manifest -> one HTML text."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from cosim.files import cannot, whole
from cosim.report import wording
from cosim.report.figures import Row
from cosim.report.html import tables
from cosim.report.html.blocks import Block, Difference, blocks
from cosim.report.html.plots import plots
from cosim.report.html.worst import last_line, worst
from cosim.report.run_folder import Run
from cosim.report.summary import not_comparable, reasons, status_counts
from cosim.workers.tasks import OK

FILE = "report.html"
PLOTTED = 12  # blocks that get plots: a page of more cannot be read, and each takes a second to draw
FINDINGS = 8  # before the fold
FAILURES = 50  # listed by name
MANIFEST = 200_000  # characters of it on the page
COMPARED = (  # of each block against its baseline
    "collision_rate",
    "av_caused_collision_rate",
    "mission_success_rate",
    "dt_mission_m",
    "dt_av_m",
    "dt_mean_m",
    "min_ttc_s",
    "hard_brakings_av",
)
TOLD = {  # of these in the verdict, in words
    "collision_rate": "collisions",
    "av_caused_collision_rate": "AV-caused collisions",
    "mission_success_rate": "mission success",
    "dt_mission_m": "the mission vehicle's distance",
    "dt_av_m": "the AVs' distance",
}


def write(run: Run, path: Path | None = None, shown: str | None = None) -> Path:
    """Write the report, by default `report.html` in the run's folder; whole or not at all.

    `shown`: the folder as commands on the page shall name it.

    Raises:
        BadInput: it cannot be written there.
    """
    path = run.path / FILE if path is None else path
    text = html(run, shown)
    with cannot("write the report", value=str(path)), whole(path) as draft:
        draft.write_text(text, encoding="utf-8")
    return path


def html(run: Run, shown: str | None = None) -> str:
    """The whole page."""
    environment = Environment(
        loader=PackageLoader("cosim.report.html", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found = blocks(run)
    differences = [block.differences(COMPARED) for block in found]
    folder = str(run.path) if shown is None else shown
    wrong = [row for row in run.rows if row["status"] != OK]
    return environment.get_template("page.html").render(
        name=run.path.resolve().name,
        verdict=_verdict(run, found),
        findings=_findings(found, differences),
        shown=FINDINGS,
        figures=tables.figures(found, run.measures) if found else None,
        sections=[_section(block, differences[k], k < PLOTTED) for k, block in enumerate(found)],
        plotted=PLOTTED,
        worst=[
            {"why": w.why, "row": w.row, "group": wording.group(w.row), "command": _replay(folder, w.row)}
            for w in worst(run.rows)
        ],
        wrong=[{"row": row, "group": wording.group(row), "line": last_line(row)} for row in wrong[:FAILURES]],
        more_wrong=max(len(wrong) - FAILURES, 0),
        reasons=reasons([row for row in run.rows if not_comparable(row)]),
        manifest=_manifest(run),
    )


# ---- inside ----


def _verdict(run: Run, found: Sequence[Block]) -> dict[str, Any]:
    """What can be said of the run as a whole: whether all was driven, and whether it may be compared."""
    status = {name: count for name, count in status_counts(run.rows).items() if count}
    total, ok = len(run.rows), status.get(OK, 0)
    missing = max((run.planned or 0) - total, 0)
    odd = sum(not_comparable(row) for row in run.rows)
    if missing:
        words = (
            f"{missing} of {_count(total + missing, 'episode')} not driven: `cosim evaluate --resume` goes on"
        )
    elif not total:
        words = "No episodes: there is nothing to judge"
    elif not ok:
        words = f"None of the {_count(total, 'episode')} gave figures"
    elif ok < total:
        words = f"{total - ok} of {_count(total, 'episode')} gave no figures"
    else:
        words = f"All {_count(total, 'episode')} finished" if total > 1 else "Finished"
    cells = sum(len(block.series) for block in found)
    return {
        "words": words,
        "tone": "bad" if not ok else "warn" if ok < total or odd or missing else "good",
        "status": status,
        "episodes": _count(total, "episode"),
        "cells": _count(cells, "cell"),
        "not_comparable": odd,
    }


def _findings(found: Sequence[Block], differences: Sequence[list[Difference]]) -> list[dict[str, Any]]:
    """Per block and series: what differs from the baseline beyond chance, and what does not."""
    lines = []
    for block, mine in zip(found, differences, strict=True):
        for difference in mine:
            told, untold = [], []
            for name, figure in difference.figures.items():
                if name not in TOLD or not figure.n:
                    continue
                tone = tables.tone(figure)
                if tone:
                    value = wording.interval(figure.difference, figure.measure, signed=True)
                    told.append({"name": TOLD[name], "value": value, "tone": tone})
                else:
                    untold.append(TOLD[name])
            lines.append(
                {
                    "block": wording.group(block.identity),
                    "series": difference.series.label,
                    "baseline": difference.baseline.label,
                    "pairs": difference.pairs,
                    "told": told,
                    "untold": untold,
                }
            )
    return lines


def _section(block: Block, differences: list[Difference], draw: bool) -> dict[str, Any]:
    return {
        "title": wording.group(block.identity),
        "plots": plots(block) if draw else [],
        "drawn": draw,
        "ok": sum(len(s.ok) for s in block.series),
        "differences": tables.differences(differences),
        "everything": tables.everything(block),
    }


def _replay(folder: str, row: Row) -> str:
    return shlex.join(["cosim", "replay", folder, str(row["key"])])


def _manifest(run: Run) -> dict[str, Any]:
    text = json.dumps(run.manifest, indent=1, ensure_ascii=False)
    seeds = run.manifest.get("seeds")
    return {
        "command": run.manifest.get("command"),
        "began": run.manifest.get("began"),
        "seeds": f"{seeds[0]} to {seeds[1] - 1}" if isinstance(seeds, list) and len(seeds) == 2 else None,
        "versions": run.manifest.get("versions") or {},
        "text": text[:MANIFEST] if run.manifest else "",
        "cut": len(text) > MANIFEST,
    }


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'s' * (number != 1)}".replace(",", " ")
