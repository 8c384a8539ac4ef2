"""Progress on stderr: what a person sees while nothing seems to happen."""

from __future__ import annotations

import io
import time

from cosim.workers.progress import STARTING, Progress


def test_a_slow_start_says_what_it_is_doing_and_a_quick_one_says_nothing() -> None:
    slow, quick = io.StringIO(), io.StringIO()
    waiting, going = Progress("run", "s", stream=slow), Progress("run", "s", stream=quick)
    waiting.starting(after=0.05)
    going.starting(after=0.05)
    going(1.0, 60.0)
    time.sleep(0.2)
    assert slow.getvalue() == f"run: {STARTING}\n"
    assert quick.getvalue() == ""


def test_nobody_is_told_once_the_stream_is_closed_or_when_quiet() -> None:
    gone, silent = io.StringIO(), io.StringIO()
    Progress("run", "s", stream=gone).starting(after=0.02)
    Progress("run", "s", stream=silent, quiet=True).starting(after=0.02)
    gone.close()
    time.sleep(0.1)
    assert silent.getvalue() == ""
