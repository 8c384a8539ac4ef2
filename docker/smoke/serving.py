"""Serves inside the container and tests requests: a scenario, an upload, a kill, a replay, a session."""

import contextlib
import http.client
import io
import json
import subprocess
import time
import zipfile
from pathlib import Path
from typing import Any

RESULTS, SCENARIOS = Path("/results"), Path("/scenarios")
PARTS = ("mine.sumocfg", "mine.net.xml", "demand/morning.rou.xml", "demand/evening.trips.xml")


def ask(path: str, sent: Any = None, kind: str = "application/json") -> bytes:
    """The body of the answer to a GET, or to a POST if something is `sent`."""
    body = sent if sent is None or isinstance(sent, bytes) else json.dumps(sent).encode()
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", 8000, timeout=120.0)) as server:
        server.request("GET" if body is None else "POST", path, body, {"Content-Type": kind})
        answer = server.getresponse()
        content = answer.read()
    assert answer.status < 300, content
    return content


def serve() -> subprocess.Popen[bytes]:
    """A server that answers within a minute."""
    log = (RESULTS / "served.log").open("a")
    server = subprocess.Popen(["cosim", "serve", "--data", "/results/served", "--workers", "2"], stderr=log)
    for _ in range(600):
        try:
            health = json.loads(ask("/health"))
        except OSError:
            time.sleep(0.1)
        else:
            assert health["uploads"], "this kernel has no Landlock, or a seccomp profile shuts it off"
            return server
    raise AssertionError((RESULTS / "served.log").read_text())


def finished(run: str) -> list[dict[str, Any]]:
    """The rows of a run once it has ended well."""
    while (status := json.loads(ask(f"/api/runs/{run}")))["status"] in ("queued", "running"):
        time.sleep(0.1)
    assert status["status"] == "finished", status
    rows: list[dict[str, Any]] = json.loads(ask(f"/api/runs/{run}/rows"))["rows"]
    assert {row["status"] for row in rows} == {"ok"}, rows
    return rows


def main() -> None:
    """An AssertionError names the first thing that is not as it must be."""
    alone = json.loads((RESULTS / "run.json").read_text())
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as packed:
        for part in PARTS:
            packed.write(SCENARIOS / part, part)
    server = serve()
    upload = json.loads(ask("/api/uploads?kind=scenario", archive.getvalue(), "application/zip"))["id"]
    sent = {"scenario": f"upload:{upload}", "demand": "demand/morning.rou.xml", "penetration": 0.3}
    mine = json.loads(ask("/api/runs", sent | {"seeds": "200000:200004", "duration": 20}))["id"]
    seed = alone["seed"]
    merge = {"scenario": "merge", "demand": "contested", "seeds": f"{seed}:{seed + 1}"}
    ours = json.loads(ask("/api/runs", merge))["id"]
    while not json.loads(ask(f"/api/runs/{mine}"))["done"]:
        time.sleep(0.05)
    server.kill()
    server.wait()
    server = serve()
    rows = finished(mine)
    assert sorted(row["seed"] for row in rows) == [*range(200000, 200004)], rows
    (row,) = finished(ours)
    assert row["trace_hash"] == alone["trace_hash"], "one episode, run alone and by the server, differs"
    page = ask(f"/api/runs/{mine}/replay?episode=200000")
    assert page.startswith(b"<!DOCTYPE html>"), page[:200]
    session = json.loads(ask("/api/sessions", {"scenario": "merge"}))["id"]
    ask(f"/api/sessions/{session}/reset", {"seed": 7})
    ask(f"/api/sessions/{session}/act", {"actions": {}})
    server.terminate()
    server.wait(timeout=30)
    print("served")


if __name__ == "__main__":
    main()
