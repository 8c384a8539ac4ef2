"""A real server in a process of its own, on a free port."""

from __future__ import annotations

import json
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
PATIENCE = 240.0  # s for what a slow machine needs; what never comes is noticed after it
COMPILING = 1800.0  # s for all kernels, where nobody has compiled them yet


class Server:
    """`cosim serve` on the folder `data`; a context manager that ends it. Its log lies beside the folder,
    or is `log`."""

    def __init__(self, data: Path, *flags: str, log: Path | None = None, **environment: str) -> None:
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
        self.log = log or data.parent / f"{data.name}.log"
        self._file = self.log.open("a")
        self._from = self.log.stat().st_size
        self.process = subprocess.Popen(command, stderr=self._file, env={**os.environ, **environment})
        deadline = time.monotonic() + PATIENCE
        while not (found := READY.search(self.log.read_text()[self._from :])):
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < deadline, "the server does not start"
            time.sleep(0.02)
        self.url = f"http://127.0.0.1:{found[2]}"
        self.http = httpx.Client(base_url=self.url, timeout=PATIENCE)
        while time.monotonic() < deadline:
            try:
                self.http.get("/health")
                break
            except httpx.ConnectError:
                time.sleep(0.02)

    def warm(self) -> None:
        """Wait until the kernels are compiled: sessions and replays do, for longer than clients wait."""
        deadline = time.monotonic() + COMPILING
        while "workers" in (problems := self.http.get("/ready").json()["problems"]):
            assert time.monotonic() < deadline, problems
            time.sleep(0.1)

    def said(self) -> list[dict[str, Any]]:
        """The lines of its log so far, but the first, which is no JSON."""
        whole, _, _ = self.log.read_text()[self._from :].rpartition("\n")
        return [json.loads(line) for line in whole.splitlines()[1:]]

    def submit(self, **request: Any) -> str:
        """The id of a run that was taken."""
        answer = self.http.post("/api/runs", json=request)
        assert answer.status_code == 201, answer.text
        return str(answer.json()["id"])

    def wait(self, run: str, status: str = "") -> dict[str, Any]:
        """The run's document once it has this status, or has ended."""
        deadline = time.monotonic() + PATIENCE
        while True:
            found: dict[str, Any] = self.http.get(f"/api/runs/{run}").json()
            if found["status"] in (status, "finished", "failed", "cancelled"):
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
        self.process.wait(timeout=PATIENCE)
        self.close()

    def close(self) -> None:
        """End it in order."""
        self.http.close()
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(timeout=PATIENCE)
        self._file.close()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
