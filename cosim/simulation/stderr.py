"""Catches what SUMO writes to C++ stderr: its exceptions only say "Process Error", the reason is there."""

from __future__ import annotations

import os
import tempfile
from types import TracebackType


class SumoStderr:
    """A context manager that sends file descriptor 2 to a hidden file while SUMO works."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the simulator
        self._real = os.dup(2)

    def __enter__(self) -> SumoStderr:
        os.dup2(self._file.fileno(), 2)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.dup2(self._real, 2)

    def take(self) -> str:
        """SUMO's words since the last call: error lines if there are any, else the last line."""
        size = os.fstat(self._file.fileno()).st_size
        self._file.seek(max(0, size - 20_000))
        lines = [line.strip() for line in self._file.read().decode("utf-8", "replace").splitlines()]
        self._file.seek(0)
        self._file.truncate()
        lines = [line for line in lines if line and not line.startswith("Quitting")]
        errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error:")]
        return "; ".join(errors or lines[-1:])

    def close(self) -> None:
        """Give the descriptors back."""
        self._file.close()
        os.close(self._real)
