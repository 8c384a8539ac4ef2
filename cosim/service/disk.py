"""Disk limits of confined processes: processes of a room above its limit are killed."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from cosim.errors import BadInput
from cosim.service.settings import MB, Limits

LOOKS = 1.0  # s between two checks
_BLOCK, _LEAST = 512, 4096  # bytes per unit of st_blocks; bytes counted for an empty file
_BEGAN = 19  # index of the start time in /proc/PID/stat, after the name


def folder_prefix() -> str:
    """The prefix of this process's folder name."""
    pid = os.getpid()
    return f"{pid}-{_began(pid)}-"


@contextlib.contextmanager
def limited(scratch: Path, writes: Sequence[Path], limits: Limits) -> Iterator[None]:
    """During the block, kill processes with a folder in `scratch` when the disk limits are exceeded.

    Limits: `limits.disk` for the content of `scratch` and new content of `writes`; `limits.free` for free
    space. Raises BadInput if a limit was exceeded.
    """
    before = sum(map(_used, writes))
    ended = threading.Event()
    problem = ""

    def watch() -> None:
        nonlocal problem
        while not ended.wait(LOOKS):
            if sum(map(_used, (scratch, *writes))) - before > limits.disk:
                problem = f"writes more than {limits.disk // MB} MB"
            elif shutil.disk_usage(scratch).free < limits.free:
                problem = f"no space left on device: {limits.free // MB} MB are kept free"
            if problem:
                _end_all(scratch)

    thread = threading.Thread(target=watch, name="cosim-disk", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        if problem:
            raise BadInput(problem, field="upload") from None


def _used(folder: Path) -> int:
    """Bytes on the disk below `folder`; links are not followed."""
    total = 0
    for path, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # removed meanwhile
                total += max(os.lstat(os.path.join(path, name)).st_blocks * _BLOCK, _LEAST)
        total += _LEAST
    return total


def _end_all(scratch: Path) -> None:
    """Kill the processes with a folder in `scratch`; the start time recognises reused process ids."""
    for folder in scratch.iterdir():
        pid, began, _ = folder.name.split("-", 2)
        with contextlib.suppress(OSError):
            if _began(int(pid)) == began:
                os.kill(int(pid), signal.SIGKILL)


def _began(pid: int) -> str:
    """Start time of a process, in ticks of the system's clock."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[_BEGAN]
