"""Supervised workers and the local engine: crashes, hangs and kills cost at most their own task."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from cosim.errors import BadInput, SimulationError
from cosim.workers.engines import LocalEngine
from cosim.workers.supervisor import Limits, Supervisor
from cosim.workers.tasks import Progress, Task, TaskQueue

QUICK = Limits(step=0.5, start=30.0)


class Driver:
    """What the workers host in these tests."""

    def __init__(self, folder: str = "") -> None:
        self._folder = Path(folder)

    def run(self, what: str, progress: Progress) -> object:
        progress(0.0, 1.0)
        if what == "crash":
            os.write(2, b"Error: the net is broken\n")
            os.kill(os.getpid(), signal.SIGSEGV)
        if what == "crash once" and not self._been_here():
            os.abort()
        if what == "shot once" and not self._been_here():
            os.kill(os.getpid(), signal.SIGKILL)
        if what == "hang":
            time.sleep(60.0)
        if what == "refuse":
            raise BadInput("no such edge", file="a.rou.xml", field="route.edges", value="x")
        if what == "fail":
            raise SimulationError("SUMO refuses")
        if what == "fault":
            raise ZeroDivisionError("a bug of ours")
        return what, os.getpid()

    def _been_here(self) -> bool:
        """False the first time, whatever process asks."""
        mark = self._folder / "mark"
        if mark.exists():
            return True
        mark.touch()
        return False

    def close(self) -> None:
        pass


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[Supervisor]:
    found = Supervisor(Driver, (str(tmp_path),), QUICK)
    yield found
    found.close()


def alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def tasks(*what: str) -> list[Task]:
    return [Task(f"{i}-{name}", name, (name,)) for i, name in enumerate(what)]


def test_what_a_task_does_to_its_process_becomes_its_outcome_and_the_next_one_is_fine(
    supervisor: Supervisor,
) -> None:
    refuse, fail, fault, crash, hang, fine = (
        supervisor.run(task) for task in tasks("refuse", "fail", "fault", "crash", "hang", "fine")
    )
    assert (refuse.status, refuse.attempts) == ("bad_input", 1)
    assert refuse.error == "a.rou.xml: route.edges='x': no such edge"
    assert (fail.status, fail.attempts, fail.error) == ("sim_crash", 1, "SUMO refuses")
    assert fault.status == "fault"
    assert fault.error is not None
    assert fault.error.endswith("ZeroDivisionError: a bug of ours")
    assert "Traceback" in (fault.stderr or "")
    assert (crash.status, crash.attempts) == ("sim_crash", 2), "the second shows that it crashes again"
    assert crash.error is not None
    assert "SIGSEGV" in crash.error
    assert crash.stderr == "Error: the net is broken"
    assert (hang.status, hang.attempts) == ("timeout", 1)
    assert hang.error is not None
    assert "no heartbeat" in hang.error
    assert (fine.status, fine.error, fine.value[0]) == ("ok", None, "fine")


def test_a_crash_that_does_not_come_back_leaves_no_mark_but_the_attempts(supervisor: Supervisor) -> None:
    outcome = supervisor.run(Task("a", "a", ("crash once",)))
    assert (outcome.status, outcome.attempts, outcome.error) == ("ok", 2, None)


def test_a_task_killed_from_outside_is_tried_again(tmp_path: Path) -> None:
    strict = Supervisor(Driver, (str(tmp_path),), Limits(crashes=1))
    outcome = strict.run(Task("a", "a", ("shot once",)))
    pid = strict.pid
    assert (outcome.status, outcome.attempts) == ("ok", 2)
    assert pid is not None
    os.kill(pid, signal.SIGKILL)  # between two tasks
    assert strict.run(Task("b", "a", ("fine",))).status == "ok"
    strict.close()


def test_a_process_is_fresh_after_so_many_tasks_and_the_same_before() -> None:
    supervisor = Supervisor(Driver, (), Limits(recycle=2))
    pids = [supervisor.run(task).value[1] for task in tasks("a", "b", "c")]
    supervisor.close()
    assert pids[0] == pids[1] != pids[2]
    assert not any(alive(pid) for pid in pids)


def test_the_local_engine_answers_every_task_once_and_leaves_no_process(tmp_path: Path) -> None:
    wanted = tasks("fine", "crash", "fine", "refuse", "fine", "fine")
    engine = LocalEngine(Driver, (str(tmp_path),), workers=2, limits=QUICK)
    outcomes = {outcome.key: outcome for outcome in engine.run(wanted)}
    assert list(outcomes) != []
    assert sorted(outcomes) == sorted(task.key for task in wanted)
    assert [outcomes[t.key].status for t in wanted] == ["ok", "sim_crash", "ok", "bad_input", "ok", "ok"]
    pids = {o.value[1] for o in outcomes.values() if o.ok}
    assert not any(alive(pid) for pid in pids)


def test_leaving_the_engine_early_ends_its_workers_at_once() -> None:
    engine = LocalEngine(Driver, workers=2)
    began = time.monotonic()
    with closing(engine.run(tasks("fine", "hang", "hang", "hang"))) as outcomes:
        pid = next(outcomes).value[1]
    assert time.monotonic() - began < 30.0, "a hanging task would last a minute"
    assert not alive(pid)
    assert not [t for t in threading.enumerate() if t.name.startswith("cosim-supervisor")]


def test_a_factory_that_fails_raises_in_the_caller() -> None:
    (outcome,) = LocalEngine(unwilling, workers=1).run(tasks("a"))
    assert (outcome.status, outcome.value) == ("fault", None)


def unwilling() -> Driver:
    raise RuntimeError("no")


def test_each_taker_keeps_to_its_group_and_helps_where_most_is_left() -> None:
    tasks_left = TaskQueue(Task(f"{g}{i}", g) for g, n in (("a", 1), ("b", 2), ("c", 5)) for i in range(n))
    one, two, three = tasks_left.take(None), tasks_left.take(None), tasks_left.take(None)
    assert [t.group for t in (one, two, three) if t] == ["a", "b", "c"], "a group each"
    helping = tasks_left.take("a")
    assert helping is not None
    assert helping.group == "c", "of the groups left, c has the most"
    own = tasks_left.take("b")
    assert own is not None
    assert own.group == "b"
    tasks_left.put_back(Task("b0", "b"))
    left = []
    while (task := tasks_left.take("c")) is not None:
        left.append(task.key)
    assert sorted(left) == ["b0", "c2", "c3", "c4"]
