"""Puts the report together: verdict, tables, plots, worst episodes, failures, manifest -> one HTML text."""

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
PLOTTED = 12  # blocks that get plots: a page of more cannot be read, and each takes a second to draw
FINDINGS = 8  # before the fold
WORST, FAILURES = 12, 50  # listed by name
MANIFEST = 200_000  # characters of it on the page
COMPARED = tuple(name for name in HEADLINE if name != "veto_rate")  # of each block against its baseline
OF_ALL = tuple(name for name in EVERYBODY if name != "co2_kg")  # which stands per km too


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
    differences, everybody, crashes, closer = (
        [block.differences(which) for block in found]
        for which in (COMPARED, OF_ALL, CRASH_RATES, NEAR_MISS_RATES)
    )
    folder = str(run.path) if shown is None else shown
    wrong = [row for row in run.rows if row["status"] != OK]
    return environment.get_template("page.html").render(
        name=run.path.resolve().name,
        verdict=_verdict(run, found),
        findings=_findings(found, differences, everybody),
        shown=FINDINGS,
        figures=tables.figures(found, run.measures) if found else None,
        everybody=tables.chosen(found, run.measures, OF_ALL),
        law=tables.law(found, run.measures),
        crashes=tables.chosen(found, run.measures, CRASH_RATES),
        near_misses=tables.chosen(found, run.measures, NEAR_MISS_RATES),
        sections=[
            _section(b, differences[k], everybody[k], crashes[k], closer[k], k < PLOTTED)
            for k, b in enumerate(found)
        ],
        plotted=PLOTTED,
        worst=[
            {
                "why": why,
                "row": row,
                "group": wording.group(row),
                "command": shlex.join(["cosim", "replay", folder, str(row["key"])]),
            }
            for why, row in _worst(run.rows)
        ],
        wrong=[
            {"row": row, "group": wording.group(row), "line": _last_line(row)} for row in wrong[:FAILURES]
        ],
        more_wrong=max(len(wrong) - FAILURES, 0),
        reasons=reasons([row for row in run.rows if not_comparable(row)]),
        traffic=_traffic(run),
        manifest=_manifest(run),
    )


# ---- inside ----


def _verdict(run: Run, found: Sequence[Block]) -> dict[str, Any]:
    """What can be said of the run as a whole: whether all was driven, and whether it may be compared."""
    status = {name: count for name, count in status_counts(run.rows).items() if count}
    total, ok = len(run.rows), status.get(OK, 0)
    missing = run.missing
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
        "guessed": sum(mission_guessed(row) for row in run.rows),
    }


def _findings(
    found: Sequence[Block],
    differences: Sequence[list[Difference]],
    everybody: Sequence[list[Difference]],
) -> list[dict[str, Any]]:
    """Per block and series: what is better and worse than the baseline beyond chance, and what is not."""
    lines = []
    for block, mine, everybodys in zip(found, differences, everybody, strict=True):
        for difference, others in zip(mine, everybodys, strict=True):
            lines.append(
                {
                    "block": wording.group(block.identity),
                    "series": difference.series.label,
                    "baseline": difference.baseline.label,
                    "pairs": difference.pairs,
                    "changes": changes(difference.figures | others.figures),
                }
            )
    return lines


def _section(
    block: Block,
    differences: list[Difference],
    everybody: list[Difference],
    crashes: list[Difference],
    closer: list[Difference],
    draw: bool,
) -> dict[str, Any]:
    return {
        "title": wording.group(block.identity),
        "plots": plots(block) if draw else [],
        "drawn": draw,
        "ok": sum(len(s.ok) for s in block.series),
        "differences": tables.differences(differences),
        "everybody": tables.differences([d for d in everybody if any(f.n for f in d.figures.values())]),
        "crashes": tables.differences([d for d in crashes if any(f.n for f in d.figures.values())]),
        "near_misses": tables.differences([d for d in closer if any(f.n for f in d.figures.values())]),
        "everything": tables.everything(block),
    }


def _worst(rows: Sequence[Row]) -> list[tuple[str, Row]]:
    """What was bad about an episode, and the episode: AV-caused crashes, other crashes, then the narrowest
    escapes; crashes of one kind by the time they happened at."""
    found = [(*_rank(row), str(row["key"]), row) for row in rows if row["status"] == OK]
    bad = sorted((f for f in found if f[2]), key=lambda f: (f[0], f[1], f[3]))
    return [(why, row) for _, _, why, _, row in bad[:WORST]]


def _rank(row: Row) -> tuple[int, float, str]:
    """Class, order within it, why; "" where nothing is bad enough."""
    text = row.get("collision_list")
    found = json.loads(text) if isinstance(text, str) else (text or [])
    first = min(found, key=lambda c: (not c.get("av_caused"), c.get("time") or 0.0), default=None)
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
    """Of an episode without figures: the last thing its simulation said, else our own words."""
    lines = [line.strip() for line in str(row.get("stderr") or "").splitlines() if line.strip()]
    return lines[-1] if lines else str(row.get("error") or "no reason given")


def _traffic(run: Run) -> dict[str, str]:
    """A user's file -> whose options drove its traffic."""
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
        "text": text[:MANIFEST] if run.manifest else "",
        "cut": len(text) > MANIFEST,
    }


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'s' * (number != 1)}".replace(",", " ")
