"""The engine for a Ray cluster: an extra, imported only when needed.

An actor per worker holds the same `Supervisor` as in the local engine, so crashes, hangs and retries are
handled alike, and SUMO never runs inside a Ray process. Ray adds the loss of an actor, alone or with its
node: its task is returned and assigned to another actor.
"""

import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Generator, Sequence
from typing import Any

from cosim.errors import BadInput, CosimError, extra
from cosim.workers.pool import Cancelled
from cosim.workers.supervisor import Factory, Limits, Supervisor
from cosim.workers.tasks import SIM_CRASH, Outcome, Task, TaskQueue

MAX_LOSSES = 6  # lost actors per task, equal to the allowed kills of a process
POLL_INTERVAL = 0.5  # s between checks for cancellation
NOTICE_DELAY = 30.0  # s without any running actor before a note is printed
_CONNECTING = threading.Lock()


class RayEngine:
    """Workers on an existing cluster (`address`) or on a local one, started and ended with the run.

    `workers`: number of actors, one core each; by default one per core of the cluster. Each node needs the
    same versions of cosim and its packages, and a user's files under the same paths (shipped scenarios are
    part of the installation).

    Raises:
        BadInput: ray is not installed, or no cluster answers at the address.
        CosimError: the cluster is gone.
    """

    def __init__(
        self,
        factory: Factory,
        arguments: tuple[Any, ...] = (),
        *,
        workers: int | None = None,
        limits: Limits | None = None,
        address: str | None = None,
        keep: bool = False,
    ) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray sends no usage report
        with extra("ray", field="--engine", value="ray"):
            import ray
        self._ray: Any = ray
        self._factory = factory
        self._arguments = arguments
        self._workers = workers
        self._limits = limits or Limits()
        self._address = address
        self._keep = keep
        self._cancelled = threading.Event()

    def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Exactly one outcome per task. Raises Cancelled when `cancel` was called."""
        if not tasks:
            return
        leaves = self._connect() and not self._keep
        actors = _Actors(self._ray, self._factory, self._arguments, self._limits, self._cancelled)
        try:
            count = self._workers or int(self._ray.cluster_resources().get("CPU", 1))
            yield from actors.drive(tasks, min(count, len(tasks)))
        except self._ray.exceptions.RaySystemError as error:
            leaves = leaves or self._keep  # the next run connects anew
            raise CosimError(f"the Ray cluster is gone: {error} (--resume continues from here)") from None
        finally:
            actors.close()
            if leaves:
                self.disconnect()

    def cancel(self) -> None:
        """End the run, from any thread: its actors are killed, `run` raises Cancelled."""
        self._cancelled.set()

    def disconnect(self) -> None:
        """Close a kept connection, and the local cluster with it."""
        with _CONNECTING:
            self._ray.shutdown()

    def _connect(self) -> bool:
        """Connect if necessary; whether a new connection was made."""
        with _CONNECTING:
            if self._ray.is_initialized():
                return False
            self._init()
            return True

    def _init(self) -> None:
        local = {"num_cpus": self._workers} if self._address is None else {}
        try:
            self._ray.init(
                address=self._address or "local",
                include_dashboard=None if self._address else False,
                log_to_driver=False,
                logging_level="ERROR",
                **local,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            words = str(error).strip().splitlines()[0]
            raise BadInput(
                f"no Ray cluster answers: {words}", field="--ray-address", value=self._address
            ) from None


class _Actors:
    """The actors and their present tasks."""

    def __init__(
        self,
        ray: Any,
        factory: Factory,
        arguments: tuple[Any, ...],
        limits: Limits,
        cancelled: threading.Event,
    ) -> None:
        self._ray = ray
        self._cancelled = cancelled
        # not restarted by Ray, since a new actor may start on another node
        self._actor = ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)(_Actor)
        self._settings = (factory, arguments, limits)
        self._calls: dict[Any, tuple[Any, Task | None, str | None]] = {}  # future -> actor, task, its group
        self._losses: Counter[str] = Counter()

    def drive(self, tasks: Sequence[Task], count: int) -> Generator[Outcome, None, None]:
        """Spread the tasks over `count` actors."""
        errors = self._ray.exceptions
        tasks_left = TaskQueue(tasks)
        left = len(tasks)
        for _ in range(count):
            self._start_actor()
        heard = time.monotonic()
        while left:
            ready, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=POLL_INTERVAL)
            if self._cancelled.is_set():
                raise Cancelled
            if ready:
                heard = time.monotonic()
            elif time.monotonic() - heard > NOTICE_DELAY:
                heard = time.monotonic()
                if all(task is None for _, task, _ in self._calls.values()):
                    print("cosim: waiting for the Ray cluster to offer a core", file=sys.stderr, flush=True)
            for future in ready:
                actor, task, group = self._calls.pop(future)
                try:
                    outcome = self._ray.get(future)
                except (
                    errors.RayTaskError,
                    errors.RaySystemError,
                ):  # an internal error, or the cluster is gone
                    raise
                except errors.RayError as error:  # the actor was lost, or its node with the result
                    self._ray.kill(actor)
                    tasks_left.leave(group)
                    outcome = None if task is None else self._lost(task, error, tasks_left)
                    self._start_actor()
                else:
                    self._assign(actor, tasks_left, group)
                if outcome is not None:
                    left -= 1
                    yield outcome

    def close(self) -> None:
        """End every actor; their worker processes end with them."""
        for actor, _, _ in self._calls.values():
            self._ray.kill(actor)
        self._calls.clear()

    def _start_actor(self) -> None:
        """Start an actor; it gets tasks once it answers, because after a node's loss no core may be free."""
        actor = self._actor.remote(*self._settings)
        self._calls[actor.ready.remote()] = (actor, None, None)

    def _assign(self, actor: Any, tasks_left: TaskQueue, group: str | None) -> None:
        task = tasks_left.take(group)
        if task is None:
            self._ray.kill(actor)  # a new actor is started if another one is lost later
        else:
            self._calls[actor.run.remote(task)] = (actor, task, task.group)

    def _lost(self, task: Task, error: Exception, tasks_left: TaskQueue) -> Outcome | None:
        """Return the task of a lost actor to the queue, up to `MAX_LOSSES` times."""
        self._losses[task.key] += 1
        if self._losses[task.key] < MAX_LOSSES:
            tasks_left.put_back(task)
            return None
        words = " ".join(str(error).split())[:500]
        problem = f"{MAX_LOSSES} Ray workers were lost with this task: {words}"
        return Outcome(task.key, SIM_CRASH, error=problem, attempts=MAX_LOSSES)


class _Actor:
    """The actor: one supervised worker process on its node."""

    def __init__(self, factory: Factory, arguments: tuple[Any, ...], limits: Limits) -> None:
        self._supervisor = Supervisor(factory, arguments, limits)

    def ready(self) -> None:
        """Returns when the actor has a core and runs."""

    def run(self, task: Task) -> Outcome:
        """One task."""
        return self._supervisor.run(task)
