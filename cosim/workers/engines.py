"""Engines that run tasks: the protocol, and the engine on processes of this machine."""

import os
import queue
import threading
from collections.abc import Generator, Sequence
from typing import Any, Protocol

from cosim.workers.supervisor import Factory, Limits, Supervisor
from cosim.workers.tasks import Outcome, Task, TaskQueue

STOP_TIMEOUT = 10.0  # s for a worker to end


class Engine(Protocol):
    """Distributes tasks over worker processes and yields outcomes in order of completion.

    Closing the generator (or leaving the loop by an exception) ends all of its processes.
    """

    def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Exactly one outcome per task."""


class LocalEngine:
    """`workers` supervised processes on this machine, each supervised by a thread of its own.

    `factory(*arguments)` builds the hosted object in each process.
    """

    def __init__(
        self,
        factory: Factory,
        arguments: tuple[Any, ...] = (),
        *,
        workers: int | None = None,
        limits: Limits | None = None,
    ) -> None:
        self._factory = factory
        self._arguments = arguments
        self._workers = workers or cores()
        self._limits = limits or Limits()

    def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Exactly one outcome per task."""
        tasks_left = TaskQueue(tasks)
        arrived: queue.SimpleQueue[Outcome | BaseException] = queue.SimpleQueue()
        supervisors = [
            Supervisor(self._factory, self._arguments, self._limits)
            for _ in range(min(self._workers, len(tasks)))
        ]
        stopped = threading.Event()

        def supervise(supervisor: Supervisor) -> None:
            group: str | None = None
            try:
                while not stopped.is_set() and (task := tasks_left.take(group)) is not None:
                    group = task.group
                    arrived.put(supervisor.run(task))
            except BaseException as error:  # an internal error: raised in the caller's thread
                arrived.put(error)
            finally:
                supervisor.close()

        threads = [
            threading.Thread(target=supervise, args=(s,), name=f"cosim-supervisor-{i}", daemon=True)
            for i, s in enumerate(supervisors)
        ]
        for thread in threads:
            thread.start()
        try:
            for _ in tasks:
                outcome = arrived.get()
                if isinstance(outcome, BaseException):
                    raise outcome
                yield outcome
            for thread in threads:
                thread.join(timeout=STOP_TIMEOUT)
        finally:
            stopped.set()
            waiting = [(s, t) for s, t in zip(supervisors, threads, strict=True) if t.is_alive()]
            for supervisor, _ in waiting:
                supervisor.kill()
            for _, thread in waiting:
                thread.join(timeout=STOP_TIMEOUT)


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
