"""Progress of long work on stderr: a bar with rate and time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TextIO, TypeVar

from tqdm import tqdm

Item = TypeVar("Item")
REDRAW = 0.1  # s between redraws on a terminal
LINE_EVERY = 10.0  # s between lines in a log; shorter work needs none
COUNTED = "{n:.0f}/{total:.0f}{unit}, {rate_noinv_fmt}, {remaining} left"
STARTING = "starting SUMO, loading the policy ..."
COMPILING = "compiling kernels (first use only: up to half a minute) ..."


class _Lines(tqdm):  # type: ignore[misc]  # tqdm is not typed
    """A line instead of each redraw."""

    @staticmethod
    def status_printer(file: TextIO) -> Callable[[str], None]:
        """The writer of a line."""
        return lambda text: print(text, file=file, flush=True)

    def close(self) -> None:
        """Nothing to clear."""
        self.disable = True


class Progress(contextlib.AbstractContextManager["Progress"]):
    """Call it with (done, total); `unit` names what is counted. Writes nothing when `quiet`.

    A total of 0 means that kernels are being compiled.

    Rate and time left are a moving average over the last reports, without the time before the first report
    (start of processes).
    """

    def __init__(self, title: str, unit: str, *, quiet: bool = False, stream: TextIO | None = None) -> None:
        self._title, self._unit, self._quiet = title, unit, quiet
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._bar: tqdm[Any] | None = None
        self._began = time.monotonic()
        self._note = threading.Timer(1.0, self.say, [STARTING])
        self._note.daemon = True

    def starting(self, after: float = 1.0) -> None:
        """Print the reason of the delay if nothing is done `after` s from now."""
        if not self._quiet:
            self._note.interval = after
            self._note.start()

    def __call__(self, done: float, total: float) -> None:
        if self._quiet:
            return
        self._note.cancel()
        if not total:
            self.say(COMPILING)
            return
        if self._bar is None:
            every = REDRAW if self._terminal else LINE_EVERY
            self._bar = (tqdm if self._terminal else _Lines)(
                desc=self._title,
                unit=f" {self._unit}",
                total=total,
                initial=done,
                file=self._stream,
                bar_format=("{desc} |{bar:30}| " if self._terminal else "{desc}: ")
                + "{percentage:3.0f}%, "
                + COUNTED,
                mininterval=every,
                delay=every,
                miniters=0,
                position=0,
                leave=False,
            )
        self._bar.total = total
        self._bar.update(min(done, total) - self._bar.n)

    def __exit__(self, *error: object) -> None:
        self.done()

    def done(self) -> None:
        """Clear the bar."""
        self._note.cancel()
        if self._bar is not None:
            if not self._terminal and time.monotonic() - self._began > LINE_EVERY:
                self._bar.refresh()  # the last line of long work
            self._bar.close()

    def say(self, line: str) -> None:
        """Write a line, above the bar if there is one."""
        if self._quiet:
            return
        bar = self._bar if self._terminal else None
        with contextlib.suppress(ValueError):  # the stream is closed
            if bar is not None:
                bar.clear()
            print(f"{self._title}: {line}", file=self._stream, flush=True)
            if bar is not None:
                bar.refresh()


def shown(items: Iterable[Item], total: int, title: str, unit: str, *, quiet: bool = False) -> Iterator[Item]:
    """The items one by one, with progress; `total`: number of items."""
    with Progress(title, unit, quiet=quiet) as progress:
        for done, item in enumerate(items, 1):
            yield item
            progress(done, total)
