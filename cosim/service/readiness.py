"""Readiness of the server: each part is checked in a separate thread with a timeout."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

TIMEOUT = 3.0  # s for the answer of a part
Check = Callable[[], str | None]  # the problem; None: no problem
log = logging.getLogger("cosim.service")


class Readiness:
    """`checks`: by the name of the part."""

    def __init__(self, checks: Mapping[str, Check]) -> None:
        self._checks = checks
        self._threads = ThreadPoolExecutor(len(checks), "cosim-ready")
        self._asked: dict[str, Future[str | None]] = {}

    async def problems(self) -> dict[str, str]:
        """Problems by part. A part whose last check is still running is not checked again."""
        for part, check in self._checks.items():
            if part not in self._asked or self._asked[part].done():
                self._asked[part] = self._threads.submit(_outcome, part, check)
        asked = dict(self._asked)
        await asyncio.wait([asyncio.wrap_future(future) for future in asked.values()], timeout=TIMEOUT)
        said = {
            part: future.result() if future.done() else f"no answer within {TIMEOUT:g} s"
            for part, future in asked.items()
        }
        return {part: problem for part, problem in said.items() if problem is not None}

    def close(self) -> None:
        """End the checks."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _outcome(part: str, check: Check) -> str | None:
    try:
        return check()
    except Exception as error:
        log.error("not ready", extra={"part": part, "error": str(error.__cause__ or error)})
        return "cannot be reached or used"
