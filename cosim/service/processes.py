"""Processes that are started for one request and end with it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

from cosim.errors import SimulationCrashed, SimulationTimeout
from cosim.service.problems import Conflict
from cosim.workers.worker import Worker


class Processes:
    """The processes of a server; `close` ends them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._workers: set[Worker] = set()
        self._closed = False

    @contextlib.contextmanager
    def host(self, factory: Callable[..., Any], *arguments: Any, **options: Any) -> Iterator[Worker]:
        """A `Worker`, which ends with the block. Raises Conflict during shutdown."""
        with Worker(factory, *arguments, wait=False, **options) as worker:
            with self._lock:
                if self._closed:
                    raise Conflict("the server is shutting down")
                self._workers.add(worker)
            try:
                yield worker
            finally:
                with self._lock:
                    self._workers.discard(worker)

    def ask(
        self, name: str, limit: float, made_of: tuple[Callable[..., Any], Any], method: str, *arguments: Any
    ) -> Any:
        """One answer of a process `name`, made from a factory and its argument, within `limit` s.

        Progress does not extend the limit. Raises what the method raises, SimulationCrashed,
        SimulationTimeout.
        """
        late = threading.Event()
        with self.host(*made_of, timeout=limit, name=name) as worker:

            def end() -> None:
                late.set()
                worker.kill()

            clock = threading.Timer(limit, end)
            clock.start()
            try:
                return worker.call(method, *arguments)
            except SimulationCrashed as error:
                if late.is_set():
                    raise SimulationTimeout(f"no answer to '{method}' within {limit:g} s") from error
                raise
            finally:
                clock.cancel()

    def close(self) -> None:
        """End all processes at once."""
        with self._lock:
            self._closed = True
            for worker in self._workers:
                worker.kill()
