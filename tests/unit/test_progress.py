"""Progress on stderr: what a person sees while nothing seems to happen."""

from __future__ import annotations

import io
from collections.abc import Callable
from types import SimpleNamespace

import pytest
import tqdm.std

from cosim.workers import progress
from cosim.workers.progress import COMPILING, STARTING, Progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


Sleep = Callable[[float], None]


@pytest.fixture
def sleep(monkeypatch: pytest.MonkeyPatch) -> Sleep:
    """Lets s pass for what is shown, at once."""
    now = 1000.0

    def clock() -> float:
        return now

    def pass_by(seconds: float) -> None:
        nonlocal now
        now += seconds

    monkeypatch.setattr(tqdm.std, "time", clock)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=clock))
    return pass_by


def report(shown: Progress, begin: int, end: int, total: int, every: float, sleep: Sleep) -> None:
    """One more is done every `every` seconds."""
    for done in range(begin, end):
        shown(done, total)
        sleep(every)


def test_a_slow_start_says_what_it_is_doing_and_a_quick_one_says_nothing() -> None:
    slow, quick = io.StringIO(), io.StringIO()
    waiting, going = Progress("run", "s", stream=slow), Progress("run", "s", stream=quick)
    going.starting(after=60.0)
    going(1.0, 60.0)
    waiting.starting(after=0.05)
    for start in (waiting, going):
        start._note.join()  # it spoke, or was told not to
    assert slow.getvalue() == f"run: {STARTING}\n"
    assert quick.getvalue() == ""


def test_nothing_is_written_once_the_stream_is_closed_or_when_quiet(sleep: Sleep) -> None:
    gone, silent = Terminal(), Terminal()
    waiting = Progress("run", "s", stream=gone)
    waiting.starting(after=0.02)
    with Progress("run", "s", stream=silent, quiet=True) as quiet:
        quiet.starting(after=0.02)
        gone.close()
        waiting._note.join()
        for shown in (waiting, quiet):
            report(shown, 0, 3, 9, 12.0, sleep)
            shown(0, 0)
    waiting.done()
    assert silent.getvalue() == ""


def test_kernels_are_named_when_they_are_compiled() -> None:
    stream = io.StringIO()
    Progress("run", "s", stream=stream)(0.0, 0.0)
    assert stream.getvalue() == f"run: {COMPILING}\n"


def test_a_log_gets_a_line_now_and_then_and_none_for_short_work(sleep: Sleep) -> None:
    long, short = io.StringIO(), io.StringIO()
    with Progress("train", "iterations", stream=long) as shown:
        report(shown, 1, 30, 100, 1.0, sleep)
    with Progress("train", "iterations", stream=short) as shown:
        report(shown, 1, 3, 3, 1.0, sleep)
    lines = long.getvalue().splitlines()
    assert 1 <= len(lines) <= 5
    assert all(line.startswith("train: ") and "/100 iterations" in line for line in lines)
    assert "\r" not in long.getvalue()
    assert short.getvalue() == ""


def test_a_terminal_gets_a_bar_that_is_cleared_at_the_end(sleep: Sleep) -> None:
    stream = Terminal()
    with Progress("run", "s", stream=stream) as shown:
        report(shown, 1, 5, 10, 1.0, sleep)
    *_, last, blank, end = stream.getvalue().split("\r")
    assert last.startswith("run |")
    assert "4/10 s" in last
    assert blank.strip() == ""
    assert end == ""


def test_the_time_left_follows_the_last_reports_and_not_the_slow_start(sleep: Sleep) -> None:
    stream = Terminal()
    shown = Progress("run", "s", stream=stream)
    sleep(50.0)  # a start at this rate would leave hours
    report(shown, 1, 21, 600, 0.5, sleep)
    assert "left" in stream.getvalue()
    assert all("04:5" in text.split(",")[-1] for text in stream.getvalue().split("\r") if "left" in text)
