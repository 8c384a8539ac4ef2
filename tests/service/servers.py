"""A real server in a process of its own, on a free port."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx

READY = re.compile(r"http://(\S+?):(\d+) \((.*)\)")


class Server:
    """`cosim serve` on the folder `data`; a context manager that ends it."""

    def __init__(self, data: Path, *flags: str, **environment: str) -> None:
        command = [
            sys.executable,
            "-m",
            "cosim.cli.main",
            "serve",
            "--port",
            "0",
            "--data",
            str(data),
            *flags,
        ]
        self.data = data
        self.log = data.parent / f"{data.name}.log"
        self._file = self.log.open("a")
        self._from = self.log.stat().st_size
        self.process = subprocess.Popen(command, stderr=self._file, env={**os.environ, **environment})
        deadline = time.monotonic() + 240.0
        while not (found := READY.search(self.log.read_text()[self._from :])):
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < deadline, "the server does not start"
            time.sleep(0.02)
        self.url = f"http://127.0.0.1:{found[2]}"
        self.http = httpx.Client(base_url=self.url, timeout=240.0)
        while time.monotonic() < deadline:
            try:
                self.http.get("/health")
                break
            except httpx.ConnectError:
                time.sleep(0.02)

    def submit(self, **request: Any) -> str:
        """The id of a run that was taken."""
        answer = self.http.post("/api/runs", json=request)
        assert answer.status_code == 201, answer.text
        return str(answer.json()["id"])

    def wait(self, run: str, *statuses: str, seconds: float = 240.0) -> dict[str, Any]:
        """The run's document once it has one of these statuses (by default: once it has ended)."""
        deadline = time.monotonic() + seconds
        while True:
            found: dict[str, Any] = self.http.get(f"/api/runs/{run}").json()
            if found["status"] in (statuses or ("finished", "failed", "cancelled")):
                return found
            assert time.monotonic() < deadline, found
            time.sleep(0.05)

    def hashes(self, run: str) -> dict[int, str]:
        """Seed -> trace hash of its rows, each of which is ok."""
        rows = self.http.get(f"/api/runs/{run}/rows").json()["rows"]
        assert all(row["status"] == "ok" for row in rows)
        return {row["seed"]: row["trace_hash"] for row in rows}

    def kill(self) -> None:
        """kill -9."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(timeout=10.0)
        self.close()

    def close(self) -> None:
        """End it in order."""
        self.http.close()
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(timeout=30.0)
        self._file.close()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
