"""The supervisor of one worker process that may crash or hang: tasks in, an outcome for each.

The hosted object (`cosim.workers.tasks.Hosted`) is built in the process and may do anything.
"""

import ctypes
import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cosim.errors import BadInput, CosimError, SimulationCrashed, SimulationError, SimulationTimeout
from cosim.workers.tasks import BAD_INPUT, FAULT, OK, SIM_CRASH, TIMEOUT, Hosted, Outcome, Progress, Task
from cosim.workers.worker import Worker

Factory = Callable[..., Hosted]

# Signals that SUMO never raises itself: sent by a person, or by the kernel when memory is short.
KILLED_FROM_OUTSIDE = frozenset(-s for s in (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT))
HEARTBEAT = 1.0  # s between two heartbeats: a message per step of 2 ms would be too expensive
PR_SET_PDEATHSIG = 1  # linux/prctl.h

_ENDS: dict[type[CosimError], str] = {  # the first class that matches an error decides
    BadInput: "refused",
    SimulationTimeout: "hung",
    SimulationCrashed: "crashed",
    SimulationError: "failed",
    CosimError: "fault",
}
# Ending of an attempt -> status of a task without a retry.
_STATUS = {
    "done": OK,
    "refused": BAD_INPUT,  # the same would be refused again
    "failed": SIM_CRASH,  # it raised, and would raise again
    "crashed": SIM_CRASH,
    "killed": SIM_CRASH,
    "hung": TIMEOUT,
    "fault": FAULT,
}


@dataclass(frozen=True, slots=True)
class Limits:
    """Timeouts and numbers of attempts."""

    step: float = 120.0  # s without a heartbeat while a task runs: a decision takes ms, at most seconds
    start: float = 600.0  # s until its first heartbeat: process, net, warm-up (A10KW: 3 s)
    crashes: int = 2  # attempts after a crash: the second shows whether it is reproducible
    kills: int = 6  # attempts after a kill from outside, which is unrelated to the task
    timeouts: int = 1  # attempts after a hang: a second attempt would hang as long
    recycle: int = 200  # tasks before a fresh process: memory was flat over 120 episodes, a precaution


class Supervisor:
    """Owns one worker process at a time. `run` never raises for a task's failure; it restarts the process.

    One thread must create, use and close it: the process ends with the thread that started it
    (PR_SET_PDEATHSIG), so that no process outlives a killed parent. Any thread may call `kill`.
    """

    def __init__(
        self, factory: Factory, arguments: tuple[Any, ...] = (), limits: Limits | None = None
    ) -> None:
        self._factory = factory
        self._arguments = arguments
        self._limits = limits or Limits()
        self._worker: Worker | None = None
        self._tasks = 0  # done by the present process
        self._ended = False

    @property
    def pid(self) -> int | None:
        """The present worker process."""
        return None if self._worker is None else self._worker.pid

    def run(self, task: Task, progress: Progress | None = None) -> Outcome:
        """One task, attempted as often as the limits say; `progress` gets its heartbeats."""
        allowed = {
            "crashed": self._limits.crashes,
            "killed": self._limits.kills,
            "hung": self._limits.timeouts,
        }
        ends: Counter[str] = Counter()
        while True:
            began = time.monotonic()
            end, value, error, stderr = self._attempt(task, progress or _nothing)
            ends[end] += 1
            if end != "done":
                if end != "refused":
                    self._drop()  # discard the process's unknown state
                if ends[end] < allowed.get(end, 1) and not self._ended:
                    continue
            seconds = time.monotonic() - began
            return Outcome(task.key, _STATUS[end], value, error, stderr, ends.total(), seconds)

    def kill(self) -> None:
        """End the process at once, from another thread; `run` returns without another attempt."""
        self._ended = True
        if (worker := self._worker) is not None:
            worker.kill()

    def close(self) -> None:
        """Ask the process to end, and kill it if necessary."""
        self._ended = True
        self._drop()

    # ---- inside ----

    def _attempt(self, task: Task, progress: Progress) -> tuple[str, Any, str | None, str | None]:
        """How the attempt ended, the value, the error in one line, and stderr of an ended process."""
        try:
            worker = self._ready()
            value = worker.call("run", task.arguments, progress=progress)
        except CosimError as error:
            end = next(end for kind, end in _ENDS.items() if isinstance(error, kind))
            if end == "crashed" and getattr(error, "exitcode", None) in KILLED_FROM_OUTSIDE:
                end = "killed"
            stderr = str(error) if end == "fault" else getattr(error, "stderr", None)
            return end, None, _line(error), stderr or None
        self._tasks += 1
        return "done", value, None, None

    def _ready(self) -> Worker:
        if self._ended:
            raise SimulationCrashed("no more tasks: the supervisor was closed")
        worker = self._worker
        if worker is not None and (self._tasks >= self._limits.recycle or worker.pid is None):
            self._drop()
        if self._worker is None:
            self._tasks = 0
            self._worker = Worker(
                _WorkerSide,
                os.getpid(),
                self._factory,
                self._arguments,
                timeout=self._limits.step + HEARTBEAT,
                start_timeout=self._limits.start,
                name="cosim-evaluation",
                wait=False,  # `kill` must reach a process that is still starting
            )
        return self._worker

    def _drop(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.close()


class _WorkerSide:
    """In the worker: builds the hosted object, limits heartbeats to one per second, ends with its parent."""

    def __init__(self, parent: int, factory: Factory, arguments: tuple[Any, ...]) -> None:
        _end_with(parent)
        self._hosted = factory(*arguments)

    def run(self, arguments: tuple[Any, ...], progress: Progress) -> Any:
        """One task."""
        last = 0.0

        def limited(done: float, total: float) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last >= HEARTBEAT:
                last = now
                progress(done, total)

        return self._hosted.run(*arguments, progress=limited)

    def close(self) -> None:
        """Close the hosted object, because the process ends."""
        self._hosted.close()


def _end_with(parent: int) -> None:
    """Have the kernel kill this process when its parent ends, even during a step of SUMO."""
    if not hasattr(ctypes, "CDLL") or os.uname().sysname != "Linux":
        return  # elsewhere the broken pipe ends this process at the next heartbeat
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent had ended before the call
        os._exit(1)


def _nothing(done: float, total: float) -> None:
    """Progress of a task without a progress bar; its calls are still heartbeats."""


def _line(error: Exception) -> str:
    """The error in one line; of a traceback the first and the last line, since stderr has all of it."""
    lines = str(error).strip().splitlines()
    if len(lines) > 1:
        lines = [lines[0], lines[-1]]
    return " ".join(" ".join(lines).split())
