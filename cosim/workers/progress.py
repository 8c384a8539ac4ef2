"""Progress of long work on stderr: a bar with rate and time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from typing import TextIO

BAR = 30  # characters
REDRAW = 0.1  # s between redraws on a terminal
LINE_EVERY = 10.0  # s between lines in a log
STARTING = "starting SUMO, compiling kernels (first use only: up to half a minute) ..."


class Progress:
    """Call it with (done, total); `unit` names what is counted. Silent when `quiet`."""

    def __init__(self, title: str, unit: str, *, quiet: bool = False, stream: TextIO | None = None) -> None:
        self._title, self._unit, self._quiet = title, unit, quiet
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._began = self._last = time.monotonic()
        self._drawn = False
        self._note: threading.Timer | None = None

    def starting(self, after: float = 3.0) -> None:
        """Say what takes so long if nothing has been done `after` s from now."""
        if not self._quiet:
            self._note = threading.Timer(after, self._say, [f"{self._title}: {STARTING}\n"])
            self._note.daemon = True
            self._note.start()

    def __call__(self, done: float, total: float) -> None:
        if self._quiet:
            return
        self._begun()
        now = time.monotonic()
        if now - self._last < (REDRAW if self._terminal else LINE_EVERY) and done < total:
            return
        if not self._terminal and now - self._began < LINE_EVERY:
            return  # short work needs no line in a log
        self._last = now
        rate = done / max(now - self._began, 1e-9)
        left = (total - done) / rate if rate > 0 else float("inf")
        share = min(done / total, 1.0) if total else 1.0
        text = f"{done:.0f}/{total:.0f} {self._unit}, {rate:.1f} {self._unit}/s, {left:.0f} s left"
        if self._terminal:
            filled = round(BAR * share)
            bar = "#" * filled + "." * (BAR - filled)
            self._stream.write(f"\r{self._title} [{bar}] {share:4.0%} {text}\x1b[K")
            self._drawn = True
        else:
            self._stream.write(f"{self._title}: {share:.0%}, {text}\n")
        self._stream.flush()

    def done(self) -> None:
        """Clear the bar."""
        self._begun()
        if self._drawn:
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def _say(self, line: str) -> None:
        with contextlib.suppress(ValueError):  # the stream is closed: nobody listens any more
            self._stream.write(line)
            self._stream.flush()

    def _begun(self) -> None:
        if self._note is not None:
            self._note.cancel()
            self._note = None
