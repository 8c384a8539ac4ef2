"""Episodes of one benchmark, each in its own process: driven once and kept as rows of a CSV file."""

from __future__ import annotations

import csv
import importlib
import json
import math
import multiprocessing
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_type_hints

from cosim.batch.episode_runner import EpisodeRunner
from cosim.files import write_csv
from cosim.scenario.options import EpisodeOptions

# a NamedTuple: the key of a case, then figures of its episode (nan: NA)
Row = TypeVar("Row", bound=tuple[Any, ...])


# drives an episode with the source code in the present folder
EPISODE = """
import json, sys
from cosim.batch.episode_runner import EpisodeRunner
from cosim.scenario.options import EpisodeOptions

if __name__ == "__main__":
    options, columns = json.loads(sys.argv[1])
    row = EpisodeRunner().run(EpisodeOptions(**options), (), None, lambda *_, **__: None)
    print(json.dumps([row[column] for column in columns]))
"""


class Case(NamedTuple):
    """One requested episode."""

    key: tuple[Any, ...]  # the first columns of its row
    options: Mapping[str, Any]  # of `EpisodeOptions`
    constants: Mapping[str, object] = {}  # `package.module.NAME` -> its value instead of the module's
    code: Path | None = None  # a folder with another version of this repository, which drives instead


def drive(case: Case, columns: Sequence[str]) -> tuple[Any, ...]:
    """The episode's values of these columns. Changes constants of this process.

    Raises AttributeError for a constant that its module does not have, ChildProcessError if other code fails.
    """
    if case.code is not None:
        return _drive_by_other_code(case, columns)
    for place, value in case.constants.items():
        name, _, constant = place.rpartition(".")
        module = importlib.import_module(name)
        getattr(module, constant)
        setattr(module, constant, value)
    row = EpisodeRunner().run(EpisodeOptions(**case.options), (), None, lambda *_, **__: None)
    return _values(row[column] for column in columns)


def measure(kind: type[Row], cases: Sequence[Case], workers: int, file: Path, again: bool) -> list[Row]:
    """All rows of `file`, in the order of the cases, after the missing cases have been driven.

    The key does not contain options that are equal for all cases, so these must not change in one file.

    Args:
        kind: a NamedTuple of the row.
        workers: processes at a time.
        file: written after every episode.
        again: drive every case, also those in `file`.
    """
    fields = get_type_hints(kind)
    rows = [] if again else read(kind, file)
    size = len(cases[0].key)
    known = {row[:size] for row in rows}
    missing = [case for case in cases if case.key not in known]
    place = {case.key: number for number, case in enumerate(cases)}
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, spawn, max_tasks_per_child=1) as pool:
        running = {pool.submit(drive, case, [*fields][size:]): case for case in missing}
        for number, done in enumerate(as_completed(running), 1):
            rows.append(kind(*running[done].key, *done.result()))
            rows.sort(key=lambda row: place.get(row[:size], -1))
            write(file, fields, rows)
            print(f"{file.stem} {number}/{len(missing)}: {running[done].key}", file=sys.stderr, flush=True)
    return rows


def read(kind: type[Row], file: Path) -> list[Row]:
    """The rows of a CSV file; none where there is no file."""
    if not file.is_file():
        return []
    types = get_type_hints(kind)
    with file.open(encoding="utf-8", newline="") as lines:
        return [kind(*(types[k](v or "nan") for k, v in row.items())) for row in csv.DictReader(lines)]


def write(file: Path, columns: Iterable[str], rows: Sequence[tuple[Any, ...]]) -> None:
    """Write the rows to a CSV file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_csv(file, [dict(zip(columns, row, strict=True)) for row in rows])


def _drive_by_other_code(case: Case, columns: Sequence[str]) -> tuple[Any, ...]:
    command = [sys.executable, "-c", EPISODE, json.dumps([dict(case.options), [*columns]])]
    found = subprocess.run(command, cwd=case.code, capture_output=True, text=True, check=False)
    if found.returncode != 0:
        raise ChildProcessError(f"{case.key}: {found.stderr.strip()[-400:]}")
    return _values(json.loads(found.stdout.splitlines()[-1]))


def _values(found: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(math.nan if value is None else value for value in found)
