"""A server whose disk is full for a while: a real one, a few megabytes of memory."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.service.postgres import until
from tests.service.servers import Server

SHORT: dict[str, Any] = {"scenario": "merge", "demand": "contested", "duration": 2, "warmup": 1}
SIZE = 24 << 20  # bytes


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """The folder that it is mounted on."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", folder], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("only root mounts a disk here: test_troubles.py has one that is said to be full")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def fill(file: Path) -> None:
    """Take what is left."""
    with file.open("wb", buffering=0) as rest, contextlib.suppress(OSError):
        while rest.write(bytes(1 << 12)):
            pass


def test_a_disk_that_is_full_for_a_while_costs_no_run(server: Server, disk: Path) -> None:
    seeds = {"seeds": "140000:140015"}
    undisturbed = server.submit(**SHORT, **seeds)
    with Server(disk / "data", "--workers", "1") as small:
        run = small.submit(**SHORT, **seeds)
        until(lambda: small.http.get(f"/api/runs/{run}").json()["done"])
        fill(disk / "rest")
        until(lambda: "run waits" in small.log.read_text())
        assert small.http.post("/api/runs", json=SHORT).status_code == 507
        assert small.http.get("/health").json()["status"] == "ok"
        assert "MB are free" in small.http.get("/ready").json()["problems"]["disk"]
        (disk / "rest").unlink()
        ended = small.wait(run)
        assert (ended["status"], ended["error"]) == ("finished", None)
        assert server.wait(undisturbed)["status"] == "finished"
        assert small.hashes(run) == server.hashes(undisturbed)
