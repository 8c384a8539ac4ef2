"""Atomic file writes, and clear errors for files that cannot be read or written."""

import contextlib
import csv
import fcntl
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.errors import BadInput


@contextlib.contextmanager
def whole(path: Path, *, contended: bool = False) -> Iterator[Path]:
    """A draft beside `path` that replaces `path` if the block succeeds, and is deleted otherwise.

    `contended`: several processes may write at the same time, and the last writer wins. Otherwise the next
    writer overwrites the draft of a killed process. OSErrors are not caught.
    """
    mine = f".{os.getpid()}" if contended else ""
    draft = path.with_name(f".{path.name}{mine}.part")
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


@contextlib.contextmanager
def cannot(
    doing: str, *, file: object = None, field: str | None = None, value: object = None
) -> Iterator[None]:
    """An OSError of the block becomes `BadInput("cannot DOING: why")` that names file, field and value."""
    try:
        yield
    except OSError as error:
        problem = f"cannot {doing}: {(error.strerror or str(error)).lower()}"
        raise BadInput(problem, file=file, field=field, value=value) from None


def read_json(path: Path, absent: str = "no such file") -> dict[str, Any]:
    """The JSON object in file `path`.

    Raises:
        BadInput: the file is missing (`absent` is the message), unreadable, or no JSON object.
    """
    try:
        with cannot("read", file=path):
            if not path.exists():
                raise BadInput(absent, file=path)
            found = json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError) as error:
        raise BadInput(f"not JSON: {error}", file=path) from None
    if not isinstance(found, dict):
        raise BadInput("not a JSON object", file=path)
    return found


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Write rows with a header atomically; numbers with six digits, NA (nan, infinities) as empty cells.

    `columns`: required if there may be no row; default: those of the first row.
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


@contextlib.contextmanager
def new_folder(path: str | None) -> Iterator[Path | None]:
    """The folder of --out, created now; removed again if it is new and the block fails.

    Raises BadInput.
    """
    new = path is not None and not Path(path).exists()
    folder = None if path is None else prepare_folder(path)
    try:
        yield folder
    except BaseException:
        if new and folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def lock(folder: Path, field: str, shown: str, worker: str = "process") -> int:
    """Lock a folder until the returned descriptor is closed (`os.close`) or the process ends.

    Raises BadInput: another `worker` is working in the folder.
    """
    with cannot("lock this folder", field=field, value=shown):
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(held)
            if isinstance(error, BlockingIOError):
                raise BadInput(f"another {worker} is working in it", field=field, value=shown) from None
            raise
    return held


@contextlib.contextmanager
def working_in(path: str) -> Iterator[Path]:
    """The folder of --out, created and locked for the block. Raises BadInput."""
    folder = prepare_folder(path)
    held = lock(folder, "--out", path)
    try:
        yield folder
    finally:
        os.close(held)


def prepare_folder(path: str, field: str = "--out") -> Path:
    """Create the folder of option `field` now, so that a bad path fails early. Raises BadInput."""
    folder = Path(path)
    with cannot("make this folder", field=field, value=path):
        folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise BadInput("cannot write into this folder", field=field, value=path)
    return folder
