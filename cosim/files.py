"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


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
