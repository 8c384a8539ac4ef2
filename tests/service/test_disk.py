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
WAITS = "run waits"  # the log of a run that met a full disk; of any other one:
ENDS = {WAITS, "run ended", "the database cannot be used"}


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


def full_while_driven(small: Server, rest: Path, **asked: Any) -> str:
    """A run that met a full disk; empty where it was quicker, and the disk has room again."""
    before = len(small.said())
    run = small.submit(**asked)
    until(lambda: small.http.get(f"/api/runs/{run}").json()["done"])
    fill(rest)
    until(lambda: ENDS & {line["message"] for line in small.said()[before:]})
    if next(line["message"] for line in small.said()[before:] if line["message"] in ENDS) == WAITS:
        return run
    rest.unlink()
    small.wait(run)
    return ""


@pytest.mark.soak
def test_a_disk_that_is_full_for_a_while_costs_no_run(server: Server, disk: Path, tmp_path: Path) -> None:
    seeds = {"seeds": "140000:140015"}
    undisturbed = server.submit(**SHORT, **seeds)
    with Server(disk / "data", "--workers", "1", log=tmp_path / "log") as small:  # which must not be full
        while not (run := full_while_driven(small, disk / "rest", **SHORT, **seeds)):
            pass
        assert small.http.post("/api/runs", json=SHORT).status_code == 507
        assert small.http.get("/health").json()["status"] == "ok"
        assert "MB are free" in small.http.get("/ready").json()["problems"]["disk"]
        (disk / "rest").unlink()
        ended = small.wait(run)
        assert (ended["status"], ended["error"]) == ("finished", None)
        assert server.wait(undisturbed)["status"] == "finished"
        assert small.hashes(run) == server.hashes(undisturbed)
