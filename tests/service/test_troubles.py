"""What the server cannot help: a database that is gone for a while, a full disk, clients that go away."""

from __future__ import annotations

import errno
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from sqlalchemy.exc import OperationalError

from cosim.errors import CosimError
from cosim.service import app, runs
from cosim.service.jobs import Jobs
from cosim.service.runs import Runs
from cosim.service.settings import DataFolder, Settings
from cosim.service.uploads import Uploads
from tests.service.servers import Server

SHORT: dict[str, Any] = {"scenario": "merge", "demand": "contested", "duration": 2, "warmup": 1}
GONE = OperationalError("SELECT", {}, Exception("the database is gone"))
FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def client(tmp_path: Path) -> Iterator[httpx.Client]:
    """The application in this process, so that its parts can be made to fail."""
    with DataFolder(str(tmp_path / "data")) as folder:
        config = uvicorn.Config(
            app.create(Settings(folder.path, workers=1)), port=0, log_config=None, access_log=False
        )
        served = uvicorn.Server(config)
        thread = threading.Thread(target=served.run)
        thread.start()
        while not served.started:
            time.sleep(0.01)
        port = served.servers[0].sockets[0].getsockname()[1]
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=240.0) as client:
            yield client
        served.should_exit = True
        thread.join(timeout=60.0)


def raising(error: Exception) -> Any:
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


def ended(client: httpx.Client, run: str) -> dict[str, Any]:
    deadline = time.monotonic() + 240.0
    while (found := client.get(f"/api/runs/{run}").json())["status"] in ("queued", "running"):
        assert time.monotonic() < deadline, found
        time.sleep(0.1)
    return dict(found)


def test_a_database_that_is_gone_for_a_while_is_waited_for(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, failures = Jobs.set, []

    def change_later(self: Jobs, run: str, **values: Any) -> None:
        if len(failures) < 3:
            failures.append(values)
            raise GONE
        change(self, run, **values)

    monkeypatch.setattr(runs, "RETRY", 0.05)
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
    place = "sqlite:////srv/data/runs/0/store.sqlite: cannot write: full (--resume goes on from here)"
    monkeypatch.setattr(runs.execution, "drive", raising(CosimError(place)))
    found = ended(client, client.post("/api/runs", json=SHORT).json()["id"])
    assert (found["status"], found["error"]) == ("failed", "the database: cannot write: full")


def test_a_fault_of_ours_is_a_problem_document(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Runs, "all", raising(ZeroDivisionError("a secret of ours")))
    answer = client.get("/api/runs")
    assert (answer.status_code, answer.json()["field"]) == (500, None)
    assert "secret" not in answer.text
    assert 'route="/api/runs",status="500"' in client.get("/metrics").text


def test_a_head_without_end_is_cut_off(server: Server) -> None:
    host, port = server.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=60.0) as one:
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
        began = time.monotonic()
        assert server.http.get("/health").json()["status"] == "ok"
        assert time.monotonic() - began < 10.0
    finally:
        for one in slow:
            one.close()
    deadline = time.monotonic() + 30.0
    while left := [*(server.data / "scratch").glob("*.zip")]:
        assert time.monotonic() < deadline, left
        time.sleep(0.05)
    lines = [json.loads(line) for line in server.log.read_text().splitlines()[1:]]
    assert not [line for line in lines if "traceback" in line]
