"""A process that is not trusted: it gets no secrets of the caller, and its answers cannot run code here.

The process starts with few environment variables, without the caller's command line and with no descriptors
except its own. Its answers are read as plain data: numbers, texts, paths, arrays, errors, and cosim's frozen
dataclasses.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import subprocess
from collections.abc import Callable
from dataclasses import is_dataclass
from enum import Enum
from multiprocessing import popen_spawn_posix, reduction, spawn, util
from multiprocessing.context import set_spawning_popen
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

MAX_ANSWER = 1 << 28  # bytes of an answer
_VARIABLES = (
    "HOME",
    "LANG",
    "LANGUAGE",
    "LD_LIBRARY_PATH",
    "MPLBACKEND",
    "PATH",
    "SUMO_HOME",
    "TMPDIR",
    "TZ",
)
_PREFIXES = ("GOMP_", "LC_", "MKL_", "NUMBA_", "OMP_", "OPENBLAS_", "PROJ_", "PYTHON")
_ARRAYS = {"_reconstruct", "scalar", "_frombuffer", "ndarray", "dtype"}
_PLAIN = {"set", "frozenset", "complex", "bytearray", "slice", "range"}
Factory = TypeVar("Factory", bound=Callable[..., Any])


def untrusted(factory: Factory) -> Factory:
    """Mark a `Worker`'s factory: its process is not trusted."""
    setattr(factory, "untrusted", True)  # noqa: B010 - a class or a function
    return factory


def is_untrusted(*parts: object) -> bool:
    """Whether a factory or one of its arguments is marked."""
    return any(getattr(part, "untrusted", False) for part in parts)


def environment() -> dict[str, str]:
    """The variables of this process that an untrusted process gets."""
    return {
        name: value for name, value in os.environ.items() if name in _VARIABLES or name.startswith(_PREFIXES)
    }


def load(answer: bytes) -> Any:
    """The data of an answer. Raises UnpicklingError for anything but plain data."""
    return _Reader(io.BytesIO(answer)).load()


class Process(multiprocessing.get_context("spawn").Process):  # type: ignore[misc]
    """A process that is not trusted."""

    @staticmethod
    def _Popen(process: BaseProcess) -> _Popen:
        return _Popen(process)


class _Popen(popen_spawn_posix.Popen):
    """multiprocessing's Popen, without the caller's command line, key and environment."""

    def _launch(self, process: BaseProcess) -> None:
        process.authkey = b""
        known = spawn.get_preparation_data(process.name)
        known.update(authkey=b"", sys_argv=[""])
        message = io.BytesIO()
        set_spawning_popen(self)
        try:
            reduction.dump(known, message)
            reduction.dump(process, message)
        finally:
            set_spawning_popen(None)
        ended, theirs = os.pipe()
        begin, ours = os.pipe()
        try:
            # no semaphore tracker: on request of the process it would remove any named semaphore
            command = spawn.get_command_line(tracker_fd=None, pipe_handle=begin)
            handles = (*self._fds, theirs, begin)  # type: ignore[attr-defined]
            started = subprocess.Popen(command, env=environment(), pass_fds=handles)
            started.returncode = 0  # multiprocessing waits for it
            self.pid = started.pid
        except BaseException:
            os.close(ended)
            os.close(ours)
            raise
        finally:
            os.close(theirs)
            os.close(begin)
        self.sentinel = ended
        self.finalizer = util.Finalize(self, _close, (ended, ours))
        with open(ours, "wb", closefd=False) as pipe:
            pipe.write(message.getbuffer())


def _close(*handles: int) -> None:
    for handle in handles:
        os.close(handle)


class _Reader(pickle.Unpickler):
    """Imports and calls only types of plain data."""

    def find_class(self, module: str, name: str) -> Any:
        """As `pickle.Unpickler`."""
        package = module.partition(".")[0]
        known = {"builtins": _PLAIN, "pathlib": {"PosixPath"}, "numpy": _ARRAYS, "cosim": {name}}
        if name in known.get(package, ()) and "." not in name:
            found = super().find_class(module, name)
            if package != "cosim" or _is_data(found) or name == "_rebuild_bad_input":
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is not plain data")


def _is_data(kind: object) -> bool:
    if not isinstance(kind, type):
        return False
    if is_dataclass(kind):
        return bool(kind.__dataclass_params__.frozen)  # type: ignore[attr-defined]
    return issubclass(kind, tuple | Enum | Exception)
