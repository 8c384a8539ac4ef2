"""Exported files of a run: episodes as Parquet and CSV, the manifest, the summary."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from cosim.batch.records import columns
from cosim.errors import CosimError
from cosim.files import whole

Row = Mapping[str, Any]


def export(
    folder: Path, rows: Sequence[Row], manifest: Mapping[str, Any], summary: Mapping[str, Any]
) -> None:
    """Write `episodes.parquet`, `episodes.csv`, `manifest.json`, `summary.json`, each atomically.

    Raises:
        CosimError: the folder cannot be written any more; the store still holds everything.
    """
    table = arrow(rows)
    writers: dict[str, Callable[[Path], object]] = {
        "episodes.parquet": lambda path: pa.parquet.write_table(table, path),
        "episodes.csv": lambda path: pa.csv.write_csv(table, path),
        "manifest.json": lambda path: path.write_text(json.dumps(manifest, indent=1) + "\n"),
        "summary.json": lambda path: path.write_text(json.dumps(summary, indent=1) + "\n"),
    }
    try:
        for name, write in writers.items():
            with whole(folder / name) as draft:
                write(draft)
    except OSError as error:
        raise CosimError(f"{folder}: cannot write: {error.strerror or error}") from None


def arrow(rows: Sequence[Row]) -> pa.Table:
    """The rows as one table; a column's type is that of its values, NA is null."""
    return pa.table({name: _column([row.get(name) for row in rows]) for name in columns(rows)})


def _column(values: list[Any]) -> pa.Array:
    kinds = {type(value) for value in values if value is not None}
    if len(kinds) > 1:  # 1 and 2.5
        values = [None if value is None else float(value) for value in values]
    return pa.array(values, None if kinds else pa.float64())  # NA throughout: no type to infer
