"""What the server cannot help: a database that is gone for a while, a full disk, clients that go away."""

from __future__ import annotations

import errno
import inspect
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
import uvicorn
from fastapi import FastAPI
from fastapi.routing import APIRoute
from sqlalchemy.exc import OperationalError

import sumo_scenarios
from cosim.errors import BadInput, CosimError
from cosim.policies import NAMES
from cosim.service import app, runs, sessions, warm
from cosim.service import client as remote
from cosim.service.jobs import Jobs
from cosim.service.runs import TRIES, Runs
from cosim.service.settings import DataFolder, Limits, Settings
from cosim.service.uploads import Uploads
from cosim.workers.worker import Worker
from tests.service.postgres import until
from tests.service.servers import PATIENCE, Server

SHORT: dict[str, Any] = {"scenario": "merge", "demand": "contested", "duration": 2, "warmup": 1}
GONE = OperationalError("SELECT", {}, Exception("the database is gone"))
FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def compiled(request: pytest.FixtureRequest) -> threading.Event:
    """Whether the kernels are compiled: at once, unless the test says False."""
    found = threading.Event()
    if getattr(request, "param", True):
        found.set()
    return found


@pytest.fixture
def limits(request: pytest.FixtureRequest) -> Limits:
    """The server's: those that the test says, or an hour and some of an episode."""
    return getattr(request, "param", Limits(simulated=4000.0, free=1))


@pytest.fixture
def application(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiled: threading.Event, limits: Limits
) -> Iterator[FastAPI]:
    """With little patience."""
    monkeypatch.setattr(warm.Warmth, "_work", lambda self: compiled.wait(PATIENCE) and self._done.set())
    monkeypatch.setattr(runs, "RETRY", 0.05)
    with DataFolder(str(tmp_path / "data")) as folder:
        yield app.create(Settings(folder.path, workers=1, limits=limits))


@pytest.fixture
def client(application: FastAPI) -> Iterator[httpx.Client]:
    """The application in this process, so that its parts can be made to fail."""
    served = uvicorn.Server(uvicorn.Config(application, port=0, log_config=None, access_log=False))
    thread = threading.Thread(target=served.run)
    thread.start()
    until(lambda: served.started or not thread.is_alive())
    port = served.servers[0].sockets[0].getsockname()[1]
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=PATIENCE) as client:
        yield client
    served.should_exit = True
    thread.join(timeout=PATIENCE)


def raising(error: Exception) -> Any:
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


def ended(client: httpx.Client, run: str) -> dict[str, Any]:
    until(lambda: client.get(f"/api/runs/{run}").json()["status"] not in ("queued", "running"))
    return dict(client.get(f"/api/runs/{run}").json())


def test_a_database_that_is_gone_for_a_while_is_waited_for(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, failures = Jobs.set, []

    def change_later(self: Jobs, run: str, **values: Any) -> None:
        if len(failures) < 3:
            failures.append(values)
            raise GONE
        change(self, run, **values)

    monkeypatch.setattr(Jobs, "set", change_later)
    run = client.post("/api/runs", json=SHORT).json()["id"]
    assert ended(client, run)["status"] == "finished"
    assert len(failures) == 3
    monkeypatch.setattr(Jobs, "get", raising(GONE))
    answer = client.get(f"/api/runs/{run}")
    assert (answer.status_code, "database" in answer.json()["problem"]) == (503, True)


def test_a_full_disk_is_said_and_a_run_that_meets_it_names_no_place(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Uploads, "add", raising(FULL))
        answer = client.post("/api/uploads", params={"kind": "scenario"}, content=b"")
        assert (answer.status_code, answer.json()["problem"]) == (507, "the server's disk is full")
        patch.setattr(os, "posix_fallocate", raising(FULL))
        answer = client.post("/api/runs", json=SHORT)
        assert (answer.status_code, "no space left" in answer.json()["problem"]) == (507, True)
    place = "sqlite:////srv/data/runs/0/store.sqlite: cannot write: full (--resume continues from here)"
    tries = []
    with monkeypatch.context() as patch:
        patch.setattr(runs, "RETRY", 0.001)
        patch.setattr(runs.execution, "drive", lambda *_: tries.append(1) or raising(CosimError(place))())
        found = ended(client, client.post("/api/runs", json=SHORT).json()["id"])
    assert (found["status"], found["error"]) == ("failed", "the database: cannot write: full")
    assert len(tries) == 1 + TRIES
    url, run = str(client.base_url), found["id"]
    assert remote.resume(url, run)["status"] != "failed"
    assert ended(client, run)["error"] is None
    assert len(client.get(f"/api/runs/{run}/rows").json()["rows"]) == 1
    with pytest.raises(BadInput, match="is finished"):
        remote.resume(url, run)


def hashes(client: httpx.Client, run: str) -> list[str]:
    """Of a run that has finished."""
    found = ended(client, run)
    assert (found["status"], found["error"]) == ("finished", None)
    rows = client.get(f"/api/runs/{run}/rows").json()["rows"]
    assert [row["error"] for row in rows if row["status"] != "ok"] == []
    return [row["trace_hash"] for row in rows]


def test_what_passes_while_a_run_is_driven_costs_it_nothing(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store that is locked, a clerk that is killed while it writes tables, a worker that is killed."""
    wanted = {**SHORT, "seeds": "140000:140003"}
    undisturbed = hashes(client, client.post("/api/runs", json=wanted).json()["id"])
    faults: list[str] = []
    add, call = runs.Store.add, Worker.call

    def locked(self: runs.Store, rows: Any) -> None:
        rows = [*rows]
        if rows and faults.count("locked") < 2:
            faults.append("locked")
            raise CosimError("sqlite:///x: cannot write: database is locked")
        add(self, rows)

    def kill(pid: int) -> None:
        with suppress(ProcessLookupError):  # it may have finished and gone: that costs nothing either
            os.kill(pid, signal.SIGKILL)

    def killing(self: Worker, method: str, *arguments: Any, **options: Any) -> Any:
        if method in ("finish", "run") and method not in faults:
            faults.append(method)
            assert self.pid is not None
            threading.Timer(0.05, kill, (self.pid,)).start()
        return call(self, method, *arguments, **options)

    monkeypatch.setattr(runs.Store, "add", locked)
    monkeypatch.setattr(Worker, "call", killing)
    assert hashes(client, client.post("/api/runs", json=wanted).json()["id"]) == undisturbed
    assert sorted(faults) == ["finish", "locked", "locked", "run"]


def test_what_is_wrong_with_a_run_itself_is_tried_once(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = []
    wrong = BadInput("has changed since the run began", field="policy")
    monkeypatch.setattr(runs.execution, "check_same", lambda *_: tries.append(1) or raising(wrong)())
    assert ended(client, client.post("/api/runs", json=SHORT).json()["id"])["status"] == "failed"
    assert len(tries) == 1


def test_a_run_that_waits_to_be_tried_again_is_cancelled_and_resumed(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(runs, "RETRY", 60.0)
        patch.setattr(runs.execution, "drive", raising(CosimError("the cluster is gone")))
        run = client.post("/api/runs", json=SHORT).json()["id"]
        until(lambda: "tried again 60 s later" in str(client.get(f"/api/runs/{run}").json()["error"]))
        assert client.post(f"/api/runs/{run}/resume").status_code == 409
        assert client.post(f"/api/runs/{run}/cancel").json()["status"] == "cancelled"
    assert client.post(f"/api/runs/{run}/resume").json()["status"] != "cancelled"
    assert len(hashes(client, run)) == 1


def test_blocking_work_waits_in_a_bounded_queue_and_holds_up_nothing_else(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()

    def slow(*_: object) -> dict[str, Any]:
        free.wait(PATIENCE)
        return {"cells": 1, "episodes": 1, "estimated_s": 1.0, "basis": "-"}

    monkeypatch.setattr(Runs, "estimate", slow)
    with ThreadPoolExecutor(60) as asking:
        asked = [asking.submit(client.post, "/api/estimates", json=SHORT) for _ in range(60)]
        until(lambda: sum(one.done() for one in asked) >= 60 - 18)  # 2 at once, 16 wait
        for path in ("/health", "/metrics", "/api/runs", "/api/catalogue"):
            assert client.get(path).status_code == 200, path
        until(lambda: client.get("/ready").status_code == 200)
        run = client.post("/api/runs", json=SHORT).json()["id"]
        assert len(hashes(client, run)) == 1
        assert sum(one.done() for one in asked) == 60 - 18
        free.set()
    answers = [one.result() for one in asked]
    assert sorted({answer.status_code for answer in answers}) == [200, 429]
    refused = next(answer for answer in answers if answer.status_code == 429)
    assert int(refused.headers["retry-after"]) > 0
    assert "18 estimates are requested already" in refused.json()["problem"]


def test_every_route_that_blocks_has_a_queue_of_its_own(application: FastAPI) -> None:
    """None shares FastAPI's threads."""
    routes = [route for route in application.routes if isinstance(route, APIRoute)]
    assert [route.path for route in routes if not inspect.iscoroutinefunction(route.endpoint)] == []


def test_a_database_that_hangs_keeps_no_probe_waiting(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()
    with monkeypatch.context() as patch:
        for name in ("get", "all", "counts"):
            patch.setattr(Jobs, name, lambda *_: free.wait(PATIENCE) and None)
        with ThreadPoolExecutor(60) as asking:
            asked = [asking.submit(client.get, f"/api/runs/{'0' * 12}/replay?episode=1") for _ in range(60)]
            for _ in range(2):
                assert client.get("/health").json()["status"] == "ok"
                answer = client.get("/ready")
                assert answer.status_code == 503
                assert answer.json()["problems"]["database"] == "no answer within 3 s"
            free.set()
    assert {one.result().status_code for one in asked} == {404}
    until(lambda: client.get("/ready").json() == {"ready": True, "problems": {}})


def test_ready_says_what_is_not_there(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Jobs, "counts", raising(GONE))
    monkeypatch.setattr(app.shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    monkeypatch.setattr(runs.Pool, "alive", 0)
    answer = client.get("/ready")
    assert (answer.status_code, answer.json()["ready"]) == (503, False)
    assert answer.json()["problems"].keys() == {"database", "disk", "workers"}


@pytest.mark.parametrize("path", ["/api/runs", "/api/estimates", "/api/sessions"])
@pytest.mark.parametrize("field", ["duration", "warmup"])
def test_an_episode_of_a_world_that_ships_has_an_end(client: httpx.Client, path: str, field: str) -> None:
    answer = client.post(path, json={**SHORT, field: 1e9})
    assert (answer.status_code, answer.json()["field"]) == (422, "duration")
    assert "at most 4000 s" in answer.json()["problem"]


# Twice to thrice what a session's imports take.
@pytest.mark.soak
@pytest.mark.parametrize("limits", [Limits(cpu=6.0, free=1)], indirect=True)
def test_an_episode_of_a_world_that_ships_has_so_much_processor_time(client: httpx.Client) -> None:
    run = client.post("/api/runs", json={**SHORT, "duration": 80_000}).json()["id"]
    assert ended(client, run)["status"] == "finished"
    (row,) = client.get(f"/api/runs/{run}/rows").json()["rows"]
    assert (row["status"], "SIGXCPU" in row["error"]) == ("sim_crash", True)
    asked = {**SHORT, "duration": 80_000, "demand": "dense", "policy": "vfn-p", "maps": False}
    path = f"/api/sessions/{client.post('/api/sessions', json=asked).json()['id']}"
    assert client.post(f"{path}/reset", json={}).status_code == 200
    decision = {"actions": {}, "see": []}
    while (answer := client.post(f"{path}/act", json=decision)).status_code == 200:
        assert not answer.json()["over"]
    assert (answer.status_code, "SIGXCPU" in answer.json()["problem"]) == (409, True)
    assert client.post(f"{path}/reset", json={}).status_code == 200  # which has as much again


def test_one_session_takes_no_more_than_its_share_of_the_threads(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()
    ids = [client.post("/api/sessions", json={**SHORT, "maps": False}).json()["id"] for _ in range(2)]
    monkeypatch.setattr(sessions.Served, "partner", lambda _: str(free.wait(PATIENCE)))
    with ThreadPoolExecutor(10) as asking:
        asked = [asking.submit(client.get, f"/api/sessions/{ids[0]}/partner") for _ in range(10)]
        until(lambda: sum(one.done() for one in asked) == 10 - sessions.CALLS)
        assert {one.result().status_code for one in asked if one.done()} == {429}
        assert client.post(f"/api/sessions/{ids[1]}/reset", json={}).status_code == 200
        free.set()


@pytest.mark.parametrize("compiled", [False], indirect=True)
def test_a_session_begins_when_the_kernels_are_there(client: httpx.Client, compiled: threading.Event) -> None:
    with ThreadPoolExecutor(1) as asking:
        asked = asking.submit(client.post, "/api/sessions", json={**SHORT, "maps": False})
        until(lambda: client.get("/ready").json()["problems"] == {"workers": "kernels are being compiled"})
        time.sleep(2.0)
        assert not asked.done()
        compiled.set()
        assert asked.result().status_code == 201
    until(lambda: client.get("/ready").status_code == 200)


def test_the_kernels_are_compiled_by_sessions_on_every_world_and_with_every_policy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun: list[Callable[[], None]] = []
    hosted = []

    def host(scenario: Any, *arguments: Any) -> Any:
        hosted.append((scenario.name, scenario.demand_name, arguments[3].args[0]))
        for compilation in begun[1:]:
            compilation()
        return SimpleNamespace(**dict.fromkeys(("reset", "scene", "act", "close"), lambda *_: None))

    monkeypatch.setattr(warm, "session_host", host)
    monkeypatch.setattr(warm, "on_compilation", begun.append)
    warm.Warmer().run(lambda *_: None)
    assert len(hosted) == 1  # which compiled nothing
    warm.Warmer().run(lambda *_: None)
    assert {name for name, _, _ in hosted} == set(sumo_scenarios.names())
    assert {policy for _, _, policy in hosted} == set(NAMES)


def test_a_fault_of_ours_is_a_problem_document(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Runs, "all", raising(ZeroDivisionError("a secret of ours")))
    answer = client.get("/api/runs")
    assert (answer.status_code, answer.json()["field"]) == (500, None)
    assert "secret" not in answer.text
    assert 'route="/api/runs",status="500"' in client.get("/metrics").text


def test_a_head_without_end_is_cut_off(server: Server) -> None:
    host, port = server.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=PATIENCE) as one:
        one.sendall(f"GET /health HTTP/1.1\r\nHost: {host}\r\nX: ".encode())
        with pytest.raises(ConnectionError):
            one.sendall(bytes(100_000_000).replace(b"\0", b"x"))


def test_a_run_that_is_removed_while_it_is_read_leaves_nothing(server: Server) -> None:
    for _ in range(5):
        run = server.submit(**SHORT, seeds="200000:201000")
        server.http.post(f"/api/runs/{run}/cancel")
        server.wait(run)
        with ThreadPoolExecutor(6) as asking:
            paths = ["rows", "report", "files", "summary"]
            answers = [asking.submit(server.http.get, f"/api/runs/{run}/{path}") for path in paths]
            answers += [asking.submit(server.http.delete, f"/api/runs/{run}") for _ in range(2)]
        assert {answer.result().status_code for answer in answers} <= {200, 204, 404, 409}
        assert not (server.data / "runs" / run).exists()


def test_a_run_whose_folder_goes_while_it_is_listed_is_not_there(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = ended(client, client.post("/api/runs", json=SHORT).json()["id"])["id"]

    def goes(*_: object) -> None:
        assert client.delete(f"/api/runs/{run}").status_code == 204
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))

    monkeypatch.setattr(Path, "glob", goes)
    assert client.get(f"/api/runs/{run}/files").status_code == 404


def test_clients_that_send_slowly_or_go_away_keep_nobody_waiting(server: Server) -> None:
    host, port = server.url.removeprefix("http://").split(":")
    slow = [socket.create_connection((host, int(port))) for _ in range(200)]
    head = f"POST /api/uploads?kind=scenario HTTP/1.1\r\nHost: {host}\r\nContent-Length: 1000\r\n\r\nPK"
    try:
        for k, one in enumerate(slow):
            one.sendall(b"GET / HT" if k % 2 else head.encode())
        assert server.http.get("/health").json()["status"] == "ok"
    finally:
        for one in slow:
            one.close()
    until(lambda: not [*(server.data / "scratch").glob("*.zip")])
    assert not [line for line in server.said() if "traceback" in line]
