"""Progress on stderr: what a person sees while nothing seems to happen."""

from __future__ import annotations

import io
import time

import pytest

from cosim.workers import progress
from cosim.workers.progress import COMPILING, STARTING, Progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything is shown a hundred times sooner."""
    monkeypatch.setattr(progress, "REDRAW", 0.001)
    monkeypatch.setattr(progress, "LINE_EVERY", 0.1)


def report(shown: Progress, begin: int, end: int, total: int, every: float) -> None:
    """One more is done every `every` seconds."""
    for done in range(begin, end):
        shown(done, total)
        time.sleep(every)


def test_a_slow_start_says_what_it_is_doing_and_a_quick_one_says_nothing() -> None:
    slow, quick = io.StringIO(), io.StringIO()
    waiting, going = Progress("run", "s", stream=slow), Progress("run", "s", stream=quick)
    waiting.starting(after=0.05)
    going.starting(after=0.05)
    going(1.0, 60.0)
    time.sleep(0.2)
    assert slow.getvalue() == f"run: {STARTING}\n"
    assert quick.getvalue() == ""


def test_nothing_is_written_once_the_stream_is_closed_or_when_quiet() -> None:
    gone, silent = Terminal(), Terminal()
    waiting = Progress("run", "s", stream=gone)
    waiting.starting(after=0.02)
    with Progress("run", "s", stream=silent, quiet=True) as quiet:
        quiet.starting(after=0.02)
        gone.close()
        time.sleep(0.1)
        for shown in (waiting, quiet):
            report(shown, 0, 3, 9, 0.12)
            shown(0, 0)
    waiting.done()
    assert silent.getvalue() == ""


def test_kernels_are_named_when_they_are_compiled() -> None:
    stream = io.StringIO()
    Progress("run", "s", stream=stream)(0.0, 0.0)
    assert stream.getvalue() == f"run: {COMPILING}\n"


@pytest.mark.usefixtures("quick")
def test_a_log_gets_a_line_now_and_then_and_none_for_short_work() -> None:
    long, short = io.StringIO(), io.StringIO()
    with Progress("train", "iterations", stream=long) as shown:
        report(shown, 1, 30, 100, 0.01)
    with Progress("train", "iterations", stream=short) as shown:
        report(shown, 1, 3, 3, 0.01)
    lines = long.getvalue().splitlines()
    assert 1 <= len(lines) <= 5
    assert all(line.startswith("train: ") and "/100 iterations" in line for line in lines)
    assert "\r" not in long.getvalue()
    assert short.getvalue() == ""


@pytest.mark.usefixtures("quick")
def test_a_terminal_gets_a_bar_that_is_cleared_at_the_end() -> None:
    stream = Terminal()
    with Progress("run", "s", stream=stream) as shown:
        report(shown, 1, 5, 10, 0.01)
    *_, last, blank, end = stream.getvalue().split("\r")
    assert last.startswith("run |")
    assert "4/10 s" in last
    assert blank.strip() == ""
    assert end == ""


@pytest.mark.usefixtures("quick")
def test_the_time_left_follows_the_last_reports_and_not_the_slow_start() -> None:
    stream = Terminal()
    shown = Progress("run", "s", stream=stream)
    time.sleep(0.5)  # a start at this rate would leave five minutes
    report(shown, 1, 21, 600, 0.005)
    assert "left" in stream.getvalue()
    assert all("00:0" in text.split(",")[-1] for text in stream.getvalue().split("\r") if "left" in text)
