"""Tasks, outcomes, and the queue that assigns tasks to workers."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from cosim.errors import BadInput, CosimError, SimulationCrashed

OK, SIM_CRASH, TIMEOUT, BAD_INPUT = STATUSES = ("ok", "sim_crash", "timeout", "bad_input")
FAULT = "fault"  # internal error: the task has no result and should be run again after a fix of the code


Progress = Callable[[float, float], None]  # a heartbeat: done, total


class Hosted(Protocol):
    """The object hosted in a worker process."""

    @property
    def run(self) -> Callable[..., Any]:
        """`run(*task.arguments, progress=...)` does one task. It calls `progress` regularly, which is the
        heartbeat that the supervisor waits for. Arguments and results must be picklable.

        Raises BadInput or SimulationError; any other exception is an internal error.
        """

    def close(self) -> None:
        """Called before the process ends."""


@dataclass(frozen=True, slots=True)
class Task:
    """One piece of work. Tasks of one `group` are cheap to do one after the other in the same process."""

    key: str  # unique among the tasks given to an engine
    group: str
    arguments: tuple[Any, ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of one task; `value` is the result of `Hosted.run`, None unless `status` is ok."""

    key: str
    status: str  # one of STATUSES, or FAULT
    value: Any = None
    error: str | None = None  # one line
    stderr: str | None = None  # end of the stderr of an ended process; for FAULT the traceback
    attempts: int = 1
    seconds: float = 0.0  # wall time of the last attempt

    @property
    def ok(self) -> bool:
        return self.status == OK

    def result(self) -> Any:
        """The value. Raises by status: BadInput, SimulationCrashed, or CosimError for an internal error."""
        if self.ok:
            return self.value
        if self.status == BAD_INPUT:
            raise BadInput(self.error or "")
        if self.status == FAULT:
            raise CosimError(self.stderr or self.error)
        raise SimulationCrashed(self.error or "", stderr=self.stderr or "")


class TaskQueue:
    """Gives tasks to many workers. A worker stays with one group while the group has tasks. Thread-safe.

    A worker without a group gets a group without workers, or else the group with most tasks left.
    """

    def __init__(self, tasks: Iterable[Task]) -> None:
        self._lock = threading.Lock()
        self._groups: dict[str, deque[Task]] = {}
        self._workers: Counter[str] = Counter()
        for task in tasks:
            self._groups.setdefault(task.group, deque()).append(task)

    def take(self, last: str | None) -> Task | None:
        """The next task of a worker whose last task was of the group `last`; None without tasks."""
        with self._lock:
            if last is not None and self._groups.get(last):
                return self._groups[last].popleft()
            if last is not None:
                self._workers[last] -= 1
                self._groups.pop(last, None)
            waiting = {name: len(tasks) for name, tasks in self._groups.items() if tasks}
            if not waiting:
                return None
            fewest = min(self._workers[name] for name in waiting)
            free = [name for name in waiting if self._workers[name] == fewest]
            group = free[0] if fewest == 0 else max(free, key=waiting.__getitem__)
            self._workers[group] += 1
            return self._groups[group].popleft()

    def put_back(self, task: Task) -> None:
        """Return the task of a lost worker; it is the next one of its group."""
        with self._lock:
            self._groups.setdefault(task.group, deque()).appendleft(task)

    def leave(self, last: str | None) -> None:
        """Sign off a worker whose last task was of the group `last`."""
        with self._lock:
            if last is not None:
                self._workers[last] -= 1
