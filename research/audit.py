"""An audit: drive a sample of the kept episodes again and compare them."""

from __future__ import annotations

import json
import random
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
    """Drive `sample` of the kept episodes, picked by `pick`, and compare every column."""
    rows = kept.episodes(settings.kept).rows
    mine = [row for row in rows if row["cell"] in work.wanted]
    picked = random.Random(pick).sample(mine, min(sample, len(mine)))
    picked.sort(key=lambda row: row["key"])  # group the episodes of a cell
    anew = _driven(picked, work, settings)
    differing = tuple(line for row in picked for line in _differences(row, anew[row["key"]]))
    return Audited(len(picked), differing, len(rows), len(rows) - len(mine))


# ---- inside ----


def _driven(rows: list[Row], work: Work, settings: Settings) -> dict[str, dict[str, Any]]:
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


def _differences(row: Row, anew: Row) -> Iterator[str]:
    """A line for every differing column."""
    if anew["status"] != OK:
        yield f"{row['key']}: {anew['status']}: {anew['error'] or anew['stderr']}"
        return
    episode = f"{row['key']}: {row['policy']} in {row['scenario']}, seed {row['seed']}"
    for name, value in kept.plain(anew).items():
        if name in row and not _same(name, row[name], value):
            yield f"{episode}: {name} is {value}, kept is {row[name]}"


def _same(name: str, before: Any, now: Any) -> bool:
    """Whether a column equals the kept one; for collisions, in the fields stored then."""
    if name != "collision_list" or before == now or None in (before, now):
        return bool(before == now)
    then, today = json.loads(before), json.loads(now)
    return len(then) == len(today) and all(
        old == {key: new.get(key) for key in old} for old, new in zip(then, today, strict=True)
    )
