"""Blocking work on separate threads per kind, with a bounded queue, so that no kind blocks another."""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

from cosim.service.clerk import CLERKS
from cosim.service.problems import Unavailable
from cosim.service.sessions import CALLS
from cosim.service.settings import Limits

EXAMINERS = DRAWERS = 2  # processes at once
P = ParamSpec("P")
T = TypeVar("T")


class Lane:
    """A queue for blocking routes, used as a decorator: `threads` at once, and `waiting` more.

    `work` names the kind of work in messages. Raises Unavailable (429) when full.
    """

    def __init__(self, work: str, threads: int, waiting: int) -> None:
        self._work, self._most = work, threads + waiting
        self._threads = ThreadPoolExecutor(threads, "cosim-lane")
        self._free = threading.BoundedSemaphore(self._most)

    def __call__(self, route: Callable[P, T]) -> Callable[P, Awaitable[T]]:
        """The route, run on a thread outside of the server's event loop."""

        @functools.wraps(route)
        async def queued(*arguments: P.args, **named: P.kwargs) -> T:
            return await self.run(functools.partial(route, *arguments, **named))

        return queued

    async def run(self, work: Callable[[], T]) -> T:
        """Run `work` on a thread; returns or raises what `work` does."""
        return await asyncio.wrap_future(self.begin(work))

    def begin(self, work: Callable[[], T]) -> Future[T]:
        """The future of `work` on a thread. Raises Unavailable when the queue is full."""
        if not self._free.acquire(blocking=False):
            raise Unavailable(f"{self._most} {self._work} are requested already: try again later")
        future = self._threads.submit(work)
        # A client's disconnect does not free the thread.
        future.add_done_callback(lambda _: self._free.release())
        return future

    def close(self) -> None:
        """Drop waiting work."""
        self._threads.shutdown(wait=False, cancel_futures=True)


class Lanes:
    """The queues of a server, by kind of work."""

    def __init__(self, limits: Limits) -> None:
        self.reads = Lane("answers", 16, 8 * limits.waiting)
        self.checks = Lane("checks of runs", CLERKS, 4 * limits.waiting)
        self.estimates = Lane("estimates", CLERKS, limits.waiting)
        self.uploads = Lane("uploads", EXAMINERS, limits.waiting)
        self.replays = Lane("replays", DRAWERS, limits.waiting)
        self.tables = Lane("reports and comparisons", CLERKS, limits.waiting)
        self.sessions = Lane("sessions' answers", (CALLS + 1) * limits.sessions, limits.waiting)

    def close(self) -> None:
        """Drop waiting work."""
        for lane in vars(self).values():
            lane.close()
