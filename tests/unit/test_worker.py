"""The supervised process: what its object raises, how it ends, and that nothing of it stays."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from pathlib import Path

import pytest

from cosim.errors import BadInput, CosimError, SimulationCrashed, SimulationError, SimulationTimeout
from cosim.simulation.stderr import SumoStderr
from cosim.workers import worker as worker_module
from cosim.workers.worker import Worker


@pytest.fixture(autouse=True)
def spawned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers start here as a user's do."""
    monkeypatch.setattr(worker_module, "_CONTEXT", multiprocessing.get_context("spawn"))


class Served:
    """What the worker holds in these tests."""

    def __init__(self, bequest: str | None = None) -> None:
        self._bequest = bequest

    def pid(self) -> int:
        return os.getpid()

    def add(self, a: int, b: int = 0) -> int:
        return a + b

    def count(self, to: int, progress: Callable[..., None]) -> str:
        for k in range(to):
            time.sleep(0.6)
            progress(k, to)
        return "done"

    def refuse(self) -> None:
        raise BadInput("must be even", file="a.xml", field="n", value=3)

    def fail(self) -> None:
        raise SimulationError("SUMO refuses")

    def fault(self) -> None:
        raise ZeroDivisionError("a bug of ours")

    def sleep(self) -> None:
        time.sleep(60.0)

    def write_and_crash(self) -> None:
        os.write(2, b"Error: the net is broken\n")
        os.kill(os.getpid(), signal.SIGSEGV)

    def temporary(self) -> str:
        return tempfile.mkstemp()[1]

    def crash_with_sumos_stderr(self) -> None:
        with SumoStderr() as stderr:
            os.write(2, b"Error: first\n")
            assert stderr.take() == "first"
            os.write(2, b"Error: SUMO cannot go on\n")
            os.kill(os.getpid(), signal.SIGSEGV)

    def leave(self) -> None:
        os._exit(3)

    def write(self) -> str:
        print("Warning: of no concern", file=sys.stderr, flush=True)
        return "ok"

    def close(self) -> None:
        if self._bequest is not None:
            Path(self._bequest).write_text("closed")


def unwilling() -> Served:
    """A factory that refuses."""
    raise BadInput("no such thing", field="what", value="x")


@pytest.fixture
def worker() -> Iterator[Worker]:
    with Worker(Served, timeout=30.0) as worker:
        yield worker


def gone(pid: int | None) -> bool:
    return not Path(f"/proc/{pid}").exists()


def test_methods_run_in_another_process_and_answer(worker: Worker) -> None:
    assert worker.call("pid") == worker.pid != os.getpid()
    assert worker.call("add", 2, b=3) == 5


def test_our_errors_come_back_whole_and_the_worker_goes_on(worker: Worker) -> None:
    with pytest.raises(BadInput, match=r"a\.xml: n=3: must be even") as caught:
        worker.call("refuse")
    assert (caught.value.file, caught.value.field, caught.value.value) == ("a.xml", "n", 3)
    with pytest.raises(SimulationError, match="SUMO refuses"):
        worker.call("fail")
    assert worker.call("add", 1) == 1


def test_a_bug_says_where_it_is(worker: Worker) -> None:
    with pytest.raises(CosimError, match=r"(?s)internal error.*fault.*ZeroDivisionError: a bug of ours"):
        worker.call("fault")
    assert worker.call("add", 1) == 1


def test_progress_is_passed_on_and_counts_as_a_heartbeat() -> None:
    seen: list[tuple[int, int]] = []
    with Worker(Served, timeout=30.0) as worker:
        worker._timeout = 2.5  # shorter than the 3 s the call takes in all
        assert worker.call("count", 5, progress=lambda k, n: seen.append((k, n))) == "done"
    assert seen == [(k, 5) for k in range(5)]


def test_a_killed_process_is_named_with_its_signal_and_call_stderr(worker: Worker) -> None:
    with pytest.raises(SimulationCrashed, match=r"SIGSEGV.*stderr ends: Error: the net is broken"):
        worker.call("write_and_crash")
    with pytest.raises(SimulationCrashed, match="ended already"):
        worker.call("add", 1)


def test_sumo_s_own_call_stderr_are_heard_too(worker: Worker) -> None:
    worker.call("write")  # stderr of an earlier call is not that of this one
    with pytest.raises(SimulationCrashed, match=r"stderr ends: Error: SUMO cannot go on") as caught:
        worker.call("crash_with_sumos_stderr")
    assert caught.value.exitcode == -signal.SIGSEGV
    assert caught.value.stderr.splitlines() == ["Error: first", "Error: SUMO cannot go on"]


def test_silence_before_the_first_heartbeat_has_a_limit_of_its_own() -> None:
    with Worker(Served, timeout=0.1, start_timeout=30.0) as worker:
        assert worker.call("add", 1) == 1, "the start took longer than 0.1 s"
        worker._start_timeout = 0.2
        with pytest.raises(SimulationTimeout, match=r"0\.2 s during 'sleep'"):
            worker.call("sleep")


def test_a_process_that_was_killed_between_calls_is_noticed(worker: Worker) -> None:
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    time.sleep(0.1)
    with pytest.raises(SimulationCrashed, match="SIGKILL"):
        worker.call("add", 1)


def test_a_process_that_leaves_is_distinguished_from_one_that_was_killed(worker: Worker) -> None:
    with pytest.raises(SimulationCrashed, match="exit code 3"):
        worker.call("leave")


def test_a_silent_process_is_killed_after_the_timeout() -> None:
    worker = Worker(Served, timeout=30.0)
    pid = worker.pid
    worker._timeout = 0.3
    began = time.monotonic()
    with pytest.raises(SimulationCrashed, match=r"no heartbeat for 0\.3 s during 'sleep'"):
        worker.call("sleep")
    assert time.monotonic() - began < 30.0
    assert gone(pid)


def test_a_factory_that_refuses_leaves_no_process() -> None:
    children = Path(f"/proc/self/task/{os.getpid()}/children")
    before = children.read_text().split()
    with pytest.raises(BadInput, match="what='x': no such thing"):
        Worker(unwilling)
    assert children.read_text().split() == before


def test_closing_closes_the_object_the_process_and_the_files(tmp_path: Path) -> None:
    resource_tracker.ensure_running()  # the first worker of a process starts it, and it stays
    files = len(os.listdir("/proc/self/fd"))
    worker = Worker(Served, str(tmp_path / "bequest"))
    pid = worker.pid
    worker.close()
    worker.close()
    assert (tmp_path / "bequest").read_text() == "closed"
    assert gone(pid)
    assert not worker._folder.exists()
    del worker  # multiprocessing frees its own two descriptors with the object
    assert len(os.listdir("/proc/self/fd")) <= files


def test_the_temporary_files_of_a_killed_process_are_deleted() -> None:
    with Worker(Served) as worker:
        file = Path(worker.call("temporary"))
        assert file.exists()
        worker.kill()
    assert not file.exists()


def test_a_process_whose_caller_is_killed_deletes_its_files() -> None:
    worker = Worker(Served)
    worker._pipe.close()  # as the end of the caller does
    worker._process.join(20.0)
    assert not worker._folder.exists()
    worker.close()


def test_a_factory_that_another_process_cannot_get_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises((AttributeError, pickle.PicklingError)):
        Worker(lambda: None)
    assert not [*tmp_path.iterdir()]


def test_two_workers_are_two_processes(worker: Worker) -> None:
    with Worker(Served) as other:
        assert worker.call("pid") != other.call("pid")


def test_what_the_process_prints_on_stderr_stays_out_of_ours(
    worker: Worker, capfd: pytest.CaptureFixture[str]
) -> None:
    assert worker.call("write") == "ok"
    assert capfd.readouterr().err == ""
