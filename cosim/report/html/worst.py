"""Which episodes to look at first, and why."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cosim.report.figures import Row
from cosim.workers.tasks import OK

SHOWN = 12


@dataclass(frozen=True, slots=True)
class Worst:
    """One episode and what was bad about it."""

    row: Row
    why: str


def worst(rows: Sequence[Row], count: int = SHOWN) -> list[Worst]:
    """The worst episodes first: AV-caused crashes, other crashes, then the narrowest escapes.

    Crashes of one kind by the time they happened at; only ok episodes with a collision, or with a time to
    collision below 1 s, are bad enough.
    """
    found = [(*_rank(row), row) for row in rows if row["status"] == OK]
    bad = sorted((f for f in found if f[0] < 3), key=lambda f: (f[0], f[1], str(f[3]["key"])))
    return [Worst(row, why) for _, _, why, row in bad[:count]]


def last_line(row: Row) -> str:
    """Of an episode without figures: the last thing its simulation said, else our own words."""
    lines = [line.strip() for line in str(row.get("stderr") or "").splitlines() if line.strip()]
    return lines[-1] if lines else str(row.get("error") or "no reason given")


def _rank(row: Row) -> tuple[int, float, str]:
    """(class, order within it, why)"""
    collisions = _collisions(row)
    first = collisions[0] if collisions else {}
    when = float(first.get("time") or 0.0)
    what = _words(first)
    if row.get("av_caused_collisions"):
        return 0, when, f"AV-caused collision{what}"
    if row.get("crashed"):
        return 1, when, f"collision{what}"
    ttc = row.get("min_ttc_s")
    if ttc is not None and not math.isnan(ttc) and ttc < 1.0:
        return 2, float(ttc), f"time to collision down to {ttc:.2f} s"
    return 3, 0.0, ""


def _collisions(row: Row) -> list[dict[str, Any]]:
    """The episode's collisions, those that an AV caused first."""
    text = row.get("collision_list")
    found = json.loads(text) if isinstance(text, str) else (text or [])
    return sorted(found, key=lambda c: (not c.get("av_caused"), c.get("time") or 0.0))


def _words(collision: dict[str, Any]) -> str:
    if not collision:
        return ""
    return f" at {collision['time']:.1f} s of SUMO's clock: {collision['collider']} hit {collision['victim']}"
