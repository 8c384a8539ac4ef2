"""Catches what SUMO writes to C++ stderr: its exceptions only say "Process Error", the reason is there."""

from __future__ import annotations

import fcntl
import os
import stat
import tempfile
from types import TracebackType

TAIL = 20_000  # bytes of it that are looked at


class SumoStderr:
    """A context manager that sends file descriptor 2 to a file while SUMO works.

    In a worker process it goes to a file already, and stays there: should SUMO kill the process, the parent
    finds SUMO's last messages in it (`cosim.workers.worker`). Elsewhere the file is a hidden one.
    """

    def __init__(self) -> None:
        self._real = os.dup(2)
        if _is_a_workers(2):
            self._file = os.dup(2)
        else:
            with tempfile.TemporaryFile() as file:
                self._file = os.dup(file.fileno())
        self._taken = os.fstat(self._file).st_size  # bytes, that are not news

    def __enter__(self) -> SumoStderr:
        os.dup2(self._file, 2)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.dup2(self._real, 2)

    def take(self) -> str:
        """SUMO's words since the last call: error lines if there are any, else the last line."""
        size = os.fstat(self._file).st_size
        begin = max(self._taken, size - TAIL)
        text = os.pread(self._file, size - begin, begin).decode("utf-8", "replace")
        self._taken = size
        lines = [line.strip() for line in text.splitlines()]
        lines = [line for line in lines if line and not line.startswith("Quitting")]
        errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error:")]
        return "; ".join(errors or lines[-1:])

    def close(self) -> None:
        """Give the descriptors back."""
        os.close(self._file)
        os.close(self._real)


def _is_a_workers(descriptor: int) -> bool:
    """A regular file that can be read back and is only appended to: how `cosim.workers.worker` opens it."""
    flags = fcntl.fcntl(descriptor, fcntl.F_GETFL)
    readable = flags & os.O_ACCMODE == os.O_RDWR
    return bool(readable and flags & os.O_APPEND and stat.S_ISREG(os.fstat(descriptor).st_mode))
