"""A pool of supervised processes shared by many batches, with an engine per batch."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Generator, Sequence
from typing import Any

from cosim.workers.engines import STOP_TIMEOUT, cores
from cosim.workers.supervisor import Factory, Limits, Supervisor
from cosim.workers.tasks import Outcome, Task, TaskQueue

MIN_TURN = 10.0  # s that a process stays with one batch while another batch has no process


class Cancelled(Exception):
    """The batch was cancelled; raised to the reader of its outcomes."""


class Pool:
    """`workers` processes, each supervised by a thread of its own, shared by all batches fairly.

    A free process goes to the batch with the fewest processes. After `MIN_TURN` s with one batch a process
    moves to a batch without any. A process is reused by the next batch with the same hosted object.
    """

    def __init__(self, workers: int | None = None) -> None:
        self.workers = workers or cores()
        self._changed = threading.Condition()
        self._batches: list[PoolEngine] = []
        self._closed = False
        self._seats = [_Seat(self, i) for i in range(self.workers)]

    @property
    def busy(self) -> int:
        """Number of processes with a task."""
        return sum(seat.batch is not None for seat in self._seats)

    @property
    def alive(self) -> int:
        """Number of processes with a live supervising thread."""
        return sum(seat.thread.is_alive() for seat in self._seats)

    def engine(
        self, factory: Factory, arguments: tuple[Any, ...] = (), *, limits: Limits | None = None
    ) -> PoolEngine:
        """An engine for one batch; `factory(*arguments)` builds the hosted object in each process."""
        return PoolEngine(self, (factory, arguments, limits or Limits()))

    def close(self) -> None:
        """End every process; readers of outcomes get `Cancelled`."""
        with self._changed:
            self._closed = True
            for batch in self._batches:
                batch.cancel()
            self._changed.notify_all()
        for seat in self._seats:
            seat.kill()
        for seat in self._seats:
            seat.thread.join(timeout=STOP_TIMEOUT)

    # ---- for the engines and the seats ----

    def begin(self, batch: PoolEngine) -> None:
        """The tasks of `batch` wait for processes."""
        with self._changed:
            if self._closed:
                raise Cancelled
            self._batches.append(batch)
            self._changed.notify_all()

    def end(self, batch: PoolEngine) -> None:
        """Withdraw `batch`: end the processes that work on it."""
        with self._changed:
            batch.ended = True
            self._batches.remove(batch)
            for seat in self._seats:
                if seat.batch is batch:
                    seat.kill()

    def take(self, seat: _Seat) -> Task | None:
        """The next task of a process, whose batch becomes `seat.batch`; waits. None: the pool is closed."""
        with self._changed:
            while not self._closed:
                crowd = {id(b): sum(s.batch is b for s in self._seats) for b in self._batches}
                choice = sorted(self._batches, key=lambda b: crowd[id(b)])
                turn_is_over = time.monotonic() - seat.since > MIN_TURN and 0 in crowd.values()
                if seat.last in choice and not turn_is_over:
                    choice.insert(0, seat.last)
                for batch in choice:
                    if (task := seat.take(batch)) is not None:
                        return task
                self._changed.wait()
            return None


class PoolEngine:
    """The `Engine` of one batch on a pool; `run` it once."""

    def __init__(self, pool: Pool, hosted: tuple[Factory, tuple[Any, ...], Limits]) -> None:
        self._pool = pool
        self.hosted = hosted
        self.tasks = TaskQueue(())
        self.ended = False
        self.arrived: queue.SimpleQueue[Outcome | BaseException] = queue.SimpleQueue()
        self.running: dict[str, tuple[float, float]] = {}  # key -> (done, total)

    def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Exactly one outcome per task. Raises Cancelled when `cancel` was called."""
        self.tasks = TaskQueue(tasks)
        self._pool.begin(self)
        try:
            for _ in tasks:
                outcome = self.arrived.get()
                if isinstance(outcome, BaseException):
                    raise outcome
                yield outcome
        finally:
            self._pool.end(self)

    def cancel(self) -> None:
        """End the batch, from any thread: its processes are killed, `run` raises Cancelled."""
        self.arrived.put(Cancelled())


class _Seat:
    """One process of the pool and the thread that supervises it."""

    def __init__(self, pool: Pool, number: int) -> None:
        self.batch: PoolEngine | None = None  # batch of its present task
        self.last: PoolEngine | None = None  # the batch of its last task,
        self.group: str | None = None  # that task's group,
        self.since = 0.0  # and when it came to that batch, s
        self._pool = pool
        self._supervisor: Supervisor | None = None
        self._hosted: object = None
        self._lock = threading.Lock()
        self.thread = threading.Thread(target=self._serve, name=f"cosim-pool-{number}", daemon=True)
        self.thread.start()

    def take(self, batch: PoolEngine) -> Task | None:
        """The next task of `batch`; None when it has none left. Call it under the pool's lock."""
        if self.last is not None and self.last is not batch:
            self.last.tasks.leave(self.group)
            self.last = self.group = None
        task = batch.tasks.take(self.group)
        if task is None:
            self.last = self.group = None
            return None
        if self.last is None:
            self.since = time.monotonic()
        self.batch = self.last = batch
        self.group = task.group
        return task

    def kill(self) -> None:
        """End the process at once; the next task gets another one."""
        with self._lock:
            if self._supervisor is not None:
                self._supervisor.kill()
            self._hosted = None

    def _serve(self) -> None:
        while (task := self._pool.take(self)) is not None:
            batch = self.batch
            assert batch is not None
            outcome: Outcome | BaseException
            try:
                outcome = self._run(batch, task)
            except BaseException as error:  # an internal error: raised to the reader of outcomes
                outcome = error
            batch.running.pop(task.key, None)
            self.batch = None
            batch.arrived.put(outcome)
        if self._supervisor is not None:
            self._supervisor.close()

    def _run(self, batch: PoolEngine, task: Task) -> Outcome:
        def progress(done: float, total: float) -> None:
            batch.running[task.key] = done, total

        with self._lock:
            if batch.ended:
                raise Cancelled
            if self._supervisor is None or self._hosted != batch.hosted:
                if self._supervisor is not None:
                    self._supervisor.close()
                self._supervisor, self._hosted = Supervisor(*batch.hosted), batch.hosted
            supervisor = self._supervisor
        progress(0.0, 0.0)
        return supervisor.run(task, progress)
