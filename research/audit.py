"""An audit: drives a sample of the kept episodes again and compares the rows."""

from __future__ import annotations

import json
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from cosim.batch.records import row as row_of
from cosim.report.figures import Row
from cosim.workers.progress import Progress
from cosim.workers.tasks import OK
from research import kept
from research.drive import Settings, Work, engine


@dataclass(frozen=True, slots=True)
class Audited:
    """The result of an audit."""

    driven: int
    differing: tuple[str, ...]  # a line each: episode, column, old and new value
    kept: int
    unknown: int  # kept episodes of no claim, or of other weights, files or versions


def audit(work: Work, settings: Settings, sample: int, pick: int = 0) -> Audited:
    """Drive `sample` of the kept episodes, drawn with the seed `pick`, and compare every column.

    No kind of episode (policy, preset, sensing) is drawn twice before every kind is drawn once.
    """
    rows = kept.episodes(settings.kept).rows
    known = [row for row in rows if row["cell"] in work.wanted]
    picked = sorted(_drawn(known, sample, pick), key=lambda row: row["key"])  # a cell's episodes in a row
    again = driven_again(picked, work, settings)
    differing = tuple(line for row in picked for line in _differences(row, again[row["key"]]))
    return Audited(len(picked), differing, len(rows), len(rows) - len(known))


def driven_again(rows: list[Row], work: Work, settings: Settings) -> dict[str, dict[str, Any]]:
    """The episodes driven again: key -> row."""
    cells = {cell.name: cell for cell in work.cells}
    cases = {row["key"]: cells[row["cell"]].case.with_seed(row["seed"]) for row in rows}
    tasks = [cells[case.cell].task(case) for case in cases.values()]
    found = {}
    with Progress("audit", "episodes") as progress, closing(engine(settings).run(tasks)) as outcomes:
        for outcome in outcomes:
            case = cases[outcome.key]
            found[outcome.key] = row_of(cells[case.cell], case, outcome)
            progress(len(found), len(tasks))
    return found


# ---- inside ----


def _drawn(rows: list[Row], sample: int, pick: int) -> list[Row]:
    """A random sample of every kind of episode in turn, so that no policy or sensing is missed."""
    met: Counter[tuple[Any, ...]] = Counter()
    turns = []
    for row in random.Random(pick).sample(rows, len(rows)):
        kind = row["policy"], row["preset"], row["sensing"]
        turns.append((met[kind], row))
        met[kind] += 1
    return [row for _, row in sorted(turns, key=lambda turn: turn[0])[:sample]]


def _differences(row: Row, again: Row) -> Iterator[str]:
    """A line for every differing column."""
    if again["status"] != OK:
        yield f"{row['key']}: {again['status']}: {again['error'] or again['stderr']}"
        return
    episode = f"{row['key']}: {row['policy']} in {row['scenario']}, seed {row['seed']}"
    for name, value in kept.plain(again).items():
        if name in row and not _same(name, row[name], value):
            yield f"{episode}: {name} is {value}, kept is {row[name]}"


def _same(name: str, before: Any, now: Any) -> bool:
    """Whether a column equals the kept one. Collisions are compared in the fields of the kept row."""
    if name != "collision_list" or before == now or None in (before, now):
        return bool(before == now)
    kept_list, new_list = json.loads(before), json.loads(now)
    return len(kept_list) == len(new_list) and all(
        old == {key: new.get(key) for key in old} for old, new in zip(kept_list, new_list, strict=True)
    )
