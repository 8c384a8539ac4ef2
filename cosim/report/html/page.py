"""The report as one HTML text: verdict, tables, plots, worst episodes, failures, manifest."""

import json
import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from cosim.files import cannot, whole
from cosim.report import wording
from cosim.report.changes import changes
from cosim.report.figures import CRASH_RATES, HEADLINE, NEAR_MISS_RATES, Row
from cosim.report.html import tables
from cosim.report.html.blocks import Block, Difference, blocks
from cosim.report.html.plots import plots
from cosim.report.result import EVERYBODY
from cosim.report.run_folder import Run
from cosim.report.summary import mission_guessed, not_comparable, reasons, status_counts
from cosim.scenario.traffic import in_words
from cosim.workers.tasks import OK

FILE = "report.html"
MAX_PLOTTED_BLOCKS = 12  # more are hard to read, and drawing one takes a second
FINDINGS_SHOWN = 8  # without unfolding
MAX_WORST, MAX_FAILURES = 12, 50  # episodes listed by name
MAX_MANIFEST_CHARACTERS = 200_000
COMPARED_FIGURES = tuple(name for name in HEADLINE if name != "veto_rate")  # with the baseline of each block
FIGURES_OF_ALL = tuple(name for name in EVERYBODY if name != "co2_kg")  # CO2 per km is included


def write(run: Run, path: Path | None = None, shown: str | None = None) -> Path:
    """Write the report atomically, by default `report.html` in the run's folder.

    `shown`: the run's folder in the commands on the page.

    Raises:
        BadInput: the file cannot be written.
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
    all_blocks = blocks(run)
    differences, everybody, crashes, near_misses = (
        [block.differences(which) for block in all_blocks]
        for which in (COMPARED_FIGURES, FIGURES_OF_ALL, CRASH_RATES, NEAR_MISS_RATES)
    )
    folder = str(run.path) if shown is None else shown
    failures = [row for row in run.rows if row["status"] != OK]
    return environment.get_template("page.html").render(
        name=run.path.resolve().name,
        verdict=_verdict(run, all_blocks),
        findings=_findings(all_blocks, differences, everybody),
        shown=FINDINGS_SHOWN,
        figures=tables.figures(all_blocks, run.measures) if all_blocks else None,
        everybody=tables.chosen(all_blocks, run.measures, FIGURES_OF_ALL),
        law=tables.law(all_blocks, run.measures),
        crashes=tables.chosen(all_blocks, run.measures, CRASH_RATES),
        near_misses=tables.chosen(all_blocks, run.measures, NEAR_MISS_RATES),
        sections=[
            _section(b, differences[k], everybody[k], crashes[k], near_misses[k], k < MAX_PLOTTED_BLOCKS)
            for k, b in enumerate(all_blocks)
        ],
        plotted=MAX_PLOTTED_BLOCKS,
        worst=[
            {
                "why": why,
                "row": row,
                "group": wording.group(row),
                "command": shlex.join(["cosim", "replay", folder, str(row["key"])]),
            }
            for why, row in _worst(run.rows)
        ],
        failures=[
            {"row": row, "group": wording.group(row), "line": _last_line(row)}
            for row in failures[:MAX_FAILURES]
        ],
        more_failures=max(len(failures) - MAX_FAILURES, 0),
        reasons=reasons([row for row in run.rows if not_comparable(row)]),
        traffic=_traffic(run),
        manifest=_manifest(run),
    )


# ---- inside ----


def _verdict(run: Run, all_blocks: Sequence[Block]) -> dict[str, Any]:
    """The run as a whole: whether every episode was driven, and whether episodes may be compared."""
    status = {name: count for name, count in status_counts(run.rows).items() if count}
    total, ok = len(run.rows), status.get(OK, 0)
    missing = run.missing
    unfit = sum(not_comparable(row) for row in run.rows)
    if missing:
        of_all = _count(total + missing, "episode")
        words = f"{missing} of {of_all} not driven: `cosim evaluate --resume` continues"
    elif not total:
        words = "No episodes"
    elif not ok:
        words = f"None of the {_count(total, 'episode')} gave figures"
    elif ok < total:
        words = f"{total - ok} of {_count(total, 'episode')} gave no figures"
    else:
        words = f"All {_count(total, 'episode')} finished" if total > 1 else "Finished"
    cells = sum(len(block.series) for block in all_blocks)
    return {
        "words": words,
        "tone": "bad" if not ok else "warn" if ok < total or unfit or missing else "good",
        "status": status,
        "episodes": _count(total, "episode"),
        "cells": _count(cells, "cell"),
        "not_comparable": unfit,
        "guessed": sum(mission_guessed(row) for row in run.rows),
    }


def _findings(
    all_blocks: Sequence[Block],
    differences: Sequence[list[Difference]],
    everybody: Sequence[list[Difference]],
) -> list[dict[str, Any]]:
    """Per block and series: figures better or worse than the baseline's beyond chance, and the others."""
    findings = []
    for block, headline, of_all in zip(all_blocks, differences, everybody, strict=True):
        for difference, of_all_vehicles in zip(headline, of_all, strict=True):
            findings.append(
                {
                    "block": wording.group(block.identity),
                    "series": difference.series.label,
                    "baseline": difference.baseline.label,
                    "pairs": difference.pairs,
                    "changes": changes(difference.figures | of_all_vehicles.figures),
                }
            )
    return findings


def _section(
    block: Block,
    differences: list[Difference],
    everybody: list[Difference],
    crashes: list[Difference],
    near_misses: list[Difference],
    draw: bool,
) -> dict[str, Any]:
    return {
        "title": wording.group(block.identity),
        "plots": plots(block) if draw else [],
        "drawn": draw,
        "ok": sum(len(s.ok) for s in block.series),
        "differences": tables.differences(differences),
        "everybody": tables.differences(everybody),
        "crashes": tables.differences(crashes),
        "near_misses": tables.differences(near_misses),
        "everything": tables.everything(block),
    }


def _worst(rows: Sequence[Row]) -> list[tuple[str, Row]]:
    """The worst episodes, each with its reason: AV-caused collisions, other collisions (both by time), then
    the smallest times to collision."""
    ranked = [(*_rank(row), str(row["key"]), row) for row in rows if row["status"] == OK]
    bad = sorted((rank for rank in ranked if rank[2]), key=lambda rank: (rank[0], rank[1], rank[3]))
    return [(why, row) for _, _, why, _, row in bad[:MAX_WORST]]


def _rank(row: Row) -> tuple[int, float, str]:
    """Class, order within the class, and reason; the reason is "" for an episode that is not bad."""
    text = row.get("collision_list")
    collisions = json.loads(text) if isinstance(text, str) else (text or [])
    first = min(collisions, key=lambda c: (not c.get("av_caused"), c.get("time") or 0.0), default=None)
    when = 0.0 if first is None else float(first.get("time") or 0.0)
    what = ""
    if first is not None:
        what = f" at {when:.1f} s of SUMO's clock: {first['collider']} hit {first['victim']}"
        what += ", after a human error" * bool(first.get("human_error_involved"))
    if row.get("av_caused_collisions"):
        return 0, when, f"AV-caused collision{what}"
    if row.get("crashed"):
        return 1, when, f"collision{what}"
    ttc = math.inf if row.get("min_ttc_s") is None else float(row["min_ttc_s"])
    return 2, ttc, f"time to collision down to {ttc:.2f} s" if ttc < 1.0 else ""


def _last_line(row: Row) -> str:
    """The last stderr line of a failed episode's simulation, else cosim's error."""
    lines = [line.strip() for line in str(row.get("stderr") or "").splitlines() if line.strip()]
    return lines[-1] if lines else str(row.get("error") or "no reason given")


def _traffic(run: Run) -> dict[str, str]:
    """A user's file -> the SUMO options of its traffic, in words."""
    cells = run.manifest.get("cells", {})
    about = {row["scenario"]: cells.get(row["cell"], {}).get("manifest", {}) for row in run.rows}
    return {name: words for name, driven in about.items() if (words := in_words(driven))}


def _manifest(run: Run) -> dict[str, Any]:
    text = json.dumps(run.manifest, indent=1, ensure_ascii=False)
    seeds = run.manifest.get("seeds")
    return {
        "command": run.manifest.get("command"),
        "began": run.manifest.get("began"),
        "seeds": f"{seeds[0]} to {seeds[1] - 1}" if isinstance(seeds, list) and len(seeds) == 2 else None,
        "versions": run.manifest.get("versions") or {},
        "text": text[:MAX_MANIFEST_CHARACTERS] if run.manifest else "",
        "cut": len(text) > MAX_MANIFEST_CHARACTERS,
    }


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'s' * (number != 1)}".replace(",", " ")
