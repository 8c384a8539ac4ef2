"""One object in a supervised process, so that a crash of SUMO does not crash the caller.

A net that crashes SUMO ends the process that imported libsumo (docs/reference/sumo.md). So whatever drives a
simulation runs in a spawned worker, called through a pipe; its crash or missing heartbeat is an exception.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from cosim.errors import CosimError, SimulationCrashed, SimulationTimeout
from cosim.workers import untrusted
from cosim.workers.memory import keep_freed_memory

STDERR = "stderr"  # file in a worker's folder
STDERR_KEPT = 4000  # last characters of a crashed process's stderr, for the error

_CONTEXT = multiprocessing.get_context("spawn")
_STARTING = threading.RLock()
_BLAS_THREADS = "OPENBLAS_NUM_THREADS"  # numpy's BLAS reads it when it is loaded


class Worker(contextlib.AbstractContextManager["Worker"]):
    """`factory(*arguments)` built in a spawned process; `call` runs one of its methods there.

    Arguments and results must be picklable. `timeout` is the longest time in s without a heartbeat (a call
    of `progress`); `start_timeout` is the longest time before the first heartbeat, of the factory and of
    each call (default: the same). A worker whose process has ended cannot be used again. Without `wait` the
    first call waits for the start, and raises the factory's exception. The process of a factory marked by
    `untrusted` is not trusted (`cosim.workers.untrusted`).

    Raises the CosimError that the method raised, SimulationCrashed when the process ended, or
    SimulationTimeout without a heartbeat.
    """

    def __init__(
        self,
        factory: Callable[..., Any],
        *arguments: Any,
        timeout: float = 300.0,
        start_timeout: float | None = None,
        name: str = "cosim",
        wait: bool = True,
    ) -> None:
        self._timeout = timeout
        self._start_timeout = start_timeout
        self._folder = Path(tempfile.mkdtemp(prefix="cosim-worker-"))  # of its temporary files
        self._stderr = (self._folder / STDERR).open("xb+", buffering=0)
        self._call_begin = 0  # bytes of stderr that belong to earlier calls
        self._pipe, theirs = _CONTEXT.Pipe()
        self._untrusted = untrusted.is_untrusted(factory, *arguments)
        self._process = (untrusted.Process if self._untrusted else _CONTEXT.Process)(
            target=_serve, args=(theirs, factory, arguments, self._folder), name=name, daemon=True
        )
        # Ctrl-C reaches the parent alone, which decides: blocked signals stay blocked in a new process
        resource_tracker.ensure_running()  # its start would unblock the signal again
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            with _one_blas_thread(), _script_left_out(factory, arguments):
                self._process.start()
        except BaseException:
            self._pipe.close()
            self._remove_files()
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self._closed = False
        self._started = False
        if wait:
            self._wait()

    @property
    def pid(self) -> int | None:
        """The process id of the worker; None once it is closed."""
        return None if self._closed else self._process.pid

    def call(
        self, method: str, *arguments: Any, progress: Callable[..., None] | None = None, **options: Any
    ) -> Any:
        """Run one method in the worker. `progress` receives what the method passes to its own `progress`."""
        if self._closed:
            raise SimulationCrashed("the simulation's process has ended already")
        self._wait()
        self._call_begin = self._stderr.seek(0, os.SEEK_END)
        try:
            self._pipe.send((method, arguments, options, progress is not None))
        except (BrokenPipeError, OSError):
            raise self._crashed(method) from None
        return self._answer(method, progress)

    def kill(self) -> None:
        """End the process at once; a call that another thread is waiting for raises SimulationCrashed."""
        with contextlib.suppress(ValueError):  # closed in the meantime
            self._process.kill()

    def close(self) -> None:
        """Ask the worker to end, and kill it if necessary. Safe to call twice."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(BrokenPipeError, OSError):
            self._pipe.send(None)
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()  # frees its descriptors now, not when the garbage collector comes
        self._pipe.close()
        self._remove_files()

    def _remove_files(self) -> None:
        self._stderr.close()
        shutil.rmtree(self._folder, ignore_errors=True)  # also what a killed simulation has left

    def __exit__(self, *error: object) -> None:
        self.close()

    def __del__(self) -> None:
        with contextlib.suppress(Exception):
            self.close()

    def _wait(self) -> None:
        """Wait until the factory has built its object."""
        if self._started:
            return
        try:
            self._answer("start", None)
        except BaseException:
            self.close()
            raise
        self._started = True

    def _answer(self, method: str, progress: Callable[..., None] | None) -> Any:
        limit = self._timeout if self._start_timeout is None else self._start_timeout
        while True:
            try:
                if not self._pipe.poll(limit):
                    self._process.kill()
                    self._process.join()
                    error = SimulationTimeout(
                        f"no heartbeat for {limit:g} s during '{method}': process killed",
                        stderr=self._call_stderr(),
                    )
                    self.close()
                    raise error
                kind, value = self._received()
                limit = self._timeout
            except (EOFError, ConnectionResetError):
                raise self._crashed(method) from None
            if kind == "progress":
                if progress is not None:
                    progress(*value)
            elif kind == "error":
                raise value
            else:
                return value

    def _received(self) -> tuple[str, Any]:
        if not self._untrusted:
            return self._pipe.recv()  # type: ignore[no-any-return]
        try:
            kind, value = untrusted.load(self._pipe.recv_bytes(untrusted.MAX_ANSWER))
            if kind in ("value", "progress") or isinstance(value, CosimError):
                return kind, value
        except (EOFError, ConnectionResetError):
            raise
        except Exception as error:  # the bytes may raise anything in the unpickler
            problem = f"{type(error).__name__}: {error}"
        else:
            problem = "not an error of cosim"
        self.kill()
        self.close()
        raise SimulationCrashed(f"the answer of the simulation's process is not plain data ({problem})")

    def _crashed(self, method: str) -> SimulationCrashed:
        self._process.join(5.0)
        code = self._process.exitcode
        how = f"exit code {code}"
        if code is not None and code < 0:
            how = f"killed by {signal.Signals(-code).name}"
        stderr = self._call_stderr()
        words = f"; stderr ends: {stderr.splitlines()[-1]}" if stderr else ""
        self.close()
        problem = f"the simulation's process ended during '{method}' ({how}){words}"
        return SimulationCrashed(problem, exitcode=code, stderr=stderr)

    def _call_stderr(self) -> str:
        """The stderr of the process during this call."""
        end = self._stderr.seek(0, os.SEEK_END)
        self._stderr.seek(max(self._call_begin, end - 4 * STDERR_KEPT))
        return self._stderr.read(4 * STDERR_KEPT).decode("utf-8", "replace").strip()[-STDERR_KEPT:]


@contextlib.contextmanager
def _script_left_out(*needed: object) -> Iterator[None]:
    """Keep multiprocessing from running the caller's script in the worker, unless it defines some `needed`.

    So scripts need no `if __name__ == "__main__"`, and a trainer's imports (torch) are not repeated beside
    every simulation.
    """
    main = sys.modules["__main__"]
    if b"__main__" in pickle.dumps(needed):
        yield
        return
    with _STARTING:
        hidden = {name: getattr(main, name, None) for name in ("__spec__", "__file__")}
        for name in hidden:
            setattr(main, name, None)
        try:
            yield
        finally:
            for name, value in hidden.items():
                setattr(main, name, value)


@contextlib.contextmanager
def _one_blas_thread() -> Iterator[None]:
    """One thread for numpy's BLAS in processes started in the block, unless the user chose a number.

    A second thread gains nothing on small matrices, and on shared cores the threads wait for one another.
    """
    with _STARTING:
        chosen = _BLAS_THREADS in os.environ
        os.environ.setdefault(_BLAS_THREADS, "1")
        try:
            yield
        finally:
            if not chosen:
                del os.environ[_BLAS_THREADS]


def _serve(pipe: Connection, factory: Callable[..., Any], arguments: tuple[Any, ...], folder: Path) -> None:
    """The worker's main loop. It ends when the pipe breaks, so the worker never outlives its parent.

    `folder`: of temporary files, and of STDERR.
    """
    keep_freed_memory()
    tempfile.tempdir = str(folder)
    os.dup2(2, 1)  # prints of a policy go to stderr: stdout is for the caller's document
    file = os.open(folder / STDERR, os.O_RDWR | os.O_APPEND)  # readable, for `cosim.simulation.stderr`
    os.dup2(file, 2)
    os.close(file)
    target, done = None, False

    def leave() -> None:
        """Exit without tearing down numba and torch, which takes longer than a short episode."""
        sys.stdout.flush()
        if done:
            os._exit(0)

    atexit.register(leave)  # registered first, so it runs last

    def attempt(work: Callable[[], Any]) -> bool:
        try:
            pipe.send(("value", work()))
            return True
        except CosimError as error:
            pipe.send(("error", error))
        except Exception as error:  # an internal error: the caller needs the traceback
            words = "".join(traceback.format_exception(error)).rstrip()
            pipe.send(("error", CosimError(f"internal error in the simulation's process:\n{words}")))
        return False

    def build() -> None:
        nonlocal target
        target = factory(*arguments)

    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        if attempt(build):
            while (message := pipe.recv()) is not None:
                method, args, options, wants_progress = message
                if wants_progress:
                    options["progress"] = lambda *values: pipe.send(("progress", values))
                attempt(lambda: getattr(target, method)(*args, **options))  # noqa: B023
    if target is not None and hasattr(target, "close"):
        with contextlib.suppress(Exception):
            target.close()
    shutil.rmtree(folder, ignore_errors=True)  # a killed caller does not
    done = True
