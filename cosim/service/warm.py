"""Compilation of the kernels at the server's start, so that no session waits for it.

numba stores compiled kernels on disk, for one processor and version.
"""

from __future__ import annotations

import functools
import logging
import math
import threading

import sumo_scenarios
from cosim.geometry.compiled import on_compilation
from cosim.policies import NAMES, make
from cosim.scenario import load
from cosim.service.confined import session_host
from cosim.types import COMPACT
from cosim.workers.supervisor import Limits, Supervisor
from cosim.workers.tasks import Progress, Task

POLICY = "vfn-p"  # calls every kernel
DECISIONS = 10
HEARTBEAT = 1800.0  # s for a session's start and decisions, compiled: half a minute on a quick machine
log = logging.getLogger("cosim.service")


class Warmth:
    """Call `start` once; `wait` returns when the kernels are compiled."""

    def __init__(self) -> None:
        self._done = threading.Event()
        self._closed = False
        self._supervisor: Supervisor | None = None
        self._thread = threading.Thread(target=self._work, name="cosim-warm", daemon=True)

    def start(self) -> None:
        """Start the compilation."""
        self._thread.start()

    def wait(self) -> None:
        """Wait until the kernels are compiled, or the compilation has failed."""
        self._done.wait()

    def problem(self) -> str | None:
        """The reason why a session would wait now; None if it would not."""
        return None if self._done.is_set() else "kernels are being compiled"

    def close(self) -> None:
        """End the compilation."""
        self._closed = True
        if self._supervisor is not None:
            self._supervisor.kill()
        self._done.set()

    def _work(self) -> None:
        self._supervisor = Supervisor(Warmer, (), Limits(step=HEARTBEAT, start=HEARTBEAT, crashes=1))
        try:
            outcome = self._supervisor.run(Task("kernels", "kernels", ()))
        finally:
            self._done.set()
            self._supervisor.close()
        if outcome.ok:
            log.info("kernels are compiled", extra={"seconds": round(outcome.seconds, 3)})
        elif not self._closed:
            log.error("kernels cannot be compiled", extra={"error": outcome.error})


class Warmer:
    """Hosted in a process: begins sessions and reads their scenes, as a page does."""

    def run(self, progress: Progress) -> None:
        """Drive a few decisions of every scenario with `POLICY`, and of every policy in one scenario.

        If the first session compiles nothing, all kernels are compiled.
        """
        compiled: list[None] = []
        on_compilation(lambda: compiled.append(None))
        worlds = [(name, demand) for name in sumo_scenarios.names() for demand in load(name).demands or {}]
        sessions = [(*world, POLICY) for world in worlds] + [(*worlds[0], policy) for policy in NAMES]
        for number, (name, demand, policy) in enumerate(sessions):
            others = functools.partial(make, policy)
            host = session_host(load(name, demand=[demand]), COMPACT, math.pi / 4, "p", others)
            host.reset(0)
            host.scene()
            for _ in range(DECISIONS):
                host.act({}, None)
            host.close()
            progress(number, len(sessions))
            if not compiled:
                return

    def close(self) -> None:
        """Nothing to close."""
