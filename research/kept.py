"""The episodes stored in the repository, reused for pages.

An exported run (`episodes.parquet`, `manifest.json`, readable by `cosim.report.run_folder`) without
machine-dependent columns. A row is reused only for exactly its cell.
"""

from __future__ import annotations

import json
import math
from collections.abc import Container, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow.parquet

from cosim.batch.export import arrow
from cosim.batch.store import Store
from cosim.files import whole
from cosim.report.figures import Row
from cosim.report.run_folder import Run, read
from cosim.workers.tasks import OK

FOLDER = Path("docs/results/episodes")
ROWS, MANIFEST = "episodes.parquet", "manifest.json"
DIGITS = 30  # binary digits of a kept float: 1e-9
ZSTD_LEVEL = 19  # high, because files are rarely written
MARK = "#"  # between a policy's name and the hash of its definitions
MACHINE_COLUMNS = ("timings", "stderr", "attempts")  # not reproducible, like each column of `timings`


def episodes(folder: Path | None) -> Run:
    """The kept episodes, possibly none. Raises BadInput for foreign files."""
    if folder is None or not (folder / ROWS).is_file():
        return Run(Path(), [])
    return _read(folder, (folder / ROWS).stat().st_mtime_ns)


def take(store: Store, wanted: Mapping[str, Container[int]], folder: Path | None) -> int:
    """Copy kept episodes of the `wanted` seeds (by cell) that the store lacks; returns their number.

    The store must contain these cells.
    """
    found, known = episodes(folder), store.keys()
    rows = [
        row for row in found.rows if row["seed"] in wanted.get(row["cell"], ()) and row["key"] not in known
    ]
    if rows:
        store.add(rows)
        document = store.document()
        for name in ("units", "better"):
            store.note(name, {**found.manifest[name], **document[name]})
    return len(rows)


def keep(store: Store, wanted: Mapping[str, Container[int]], folder: Path) -> int:
    """Write the completed wanted episodes of the store; returns their number.

    Kept episodes that are no longer wanted are removed. The store must hold the others (`drive.opened`).
    """
    rows = [row for row in store.rows() if row["status"] == OK and row["seed"] in wanted.get(row["cell"], ())]
    present, cells, document = {row["cell"] for row in rows}, store.cells(), store.document()
    manifest = {
        "versions": next((about["manifest"]["versions"] for about in cells.values()), {}),
        **{name: document[name] for name in ("units", "better")},
        "cells": {cell: _replayable(about) for cell, about in cells.items() if cell in present},
    }
    if rows:
        write(rows, manifest, folder)
    return len(rows)


def write(rows: Sequence[Row], manifest: Mapping[str, Any], folder: Path) -> None:
    """Write the rows, by cell and seed, and the manifest, each file atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    place = {name: k for k, name in enumerate(manifest["cells"])}
    table = arrow([plain(row) for row in sorted(rows, key=lambda r: (place[r["cell"]], r["seed"]))])
    with whole(folder / ROWS) as rows_draft, whole(folder / MANIFEST) as draft:
        floats = [field.name for field in table.schema if pyarrow.types.is_floating(field.type)]
        pyarrow.parquet.write_table(
            table,
            rows_draft,
            compression="zstd",
            compression_level=ZSTD_LEVEL,
            use_dictionary=[name for name in table.column_names if name not in floats],
            use_byte_stream_split=floats,
        )
        draft.write_text(json.dumps(manifest, separators=(",", ":")) + "\n", encoding="utf-8")


def plain(row: Row) -> dict[str, Any]:
    """The row without machine-dependent columns, equal when the episode is driven again.

    Floats are rounded to `DIGITS`, far below any interval, because the file is part of every checkout.
    """
    left_out = (*MACHINE_COLUMNS, *json.loads(row.get("timings") or "{}"))
    return {name: _rounded(value) for name, value in row.items() if name not in left_out}


def packages(versions: Mapping[str, str | None]) -> dict[str, str]:
    """The versions that affect an episode: without Python's, and without local labels (`+cpu`)."""
    return {name: (version or "").partition("+")[0] for name, version in versions.items() if name != "python"}


def unmarked(text: str) -> str:
    """The policy's name for `--policy`, without the mark and the hash."""
    return text.partition(MARK)[0]


def _rounded(value: Any) -> Any:
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    fraction, exponent = math.frexp(value)
    return math.ldexp(round(math.ldexp(fraction, DIGITS)), exponent - DIGITS)


def _replayable(cell: Mapping[str, Any]) -> dict[str, Any]:
    """A cell as `cosim replay` drives it."""
    case = cell["case"]
    return {**cell, "case": {**case, "policy": unmarked(case["policy"])}}


@cache
def _read(folder: Path, modified: int) -> Run:  # noqa: ARG001 - a changed file is read anew
    return read(folder)
