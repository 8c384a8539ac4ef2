"""Files that appear whole or not at all, and what is said when they cannot be written."""

from __future__ import annotations

import contextlib
import csv
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.errors import BadInput


@contextlib.contextmanager
def whole(path: Path, *, contended: bool = False) -> Iterator[Path]:
    """A draft beside `path` that takes its place when the block ends well, and is gone when it does not.

    `contended`: several processes may write it at the same time, and the last one's stands. What a killed
    process has left is written over by the next one, where nobody contends. OSErrors are not caught.
    """
    mine = f".{os.getpid()}" if contended else ""
    draft = path.with_name(f".{path.name}{mine}.part")
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


@contextlib.contextmanager
def writing(problem: str = "cannot write", **place: Any) -> Iterator[None]:
    """Raises BadInput for an OSError of the block; `place`: the file, field and value that it names."""
    try:
        yield
    except OSError as error:
        raise BadInput(f"{problem}: {error.strerror or error}", **place) from None


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Rows with a header, whole or not at all; numbers with six digits, NA (nan, infinities) is empty.

    `columns`: needed where there may be no row; default: those of the first.
    """
    with whole(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0] if columns is None else columns))
        writer.writeheader()
        for row in rows:
            writer.writerow({name: _plain(value) for name, value in row.items()})


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else ""
    return value


def prepare_folder(path: str) -> Path:
    """Make the run folder now, so that a bad path fails before the simulation. Raises BadInput."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"cannot make this folder: {error.strerror}", field="--out", value=path) from None
    if not os.access(folder, os.W_OK):
        raise BadInput("cannot write into this folder", field="--out", value=path)
    return folder
