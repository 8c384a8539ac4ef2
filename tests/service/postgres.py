"""A real PostgreSQL of its own that can be stopped, started and made to drop connections."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

from tests.service.servers import PATIENCE

BINARIES = next(iter(sorted(glob.glob("/usr/lib/postgresql/*/bin"), reverse=True)), None)
needed = pytest.mark.skipif(BINARIES is None, reason="no PostgreSQL is installed: apt-get install postgresql")


class Postgres:
    """A context manager; `url(role)` reaches it, as a role that is made then.

    It listens on a socket in its own folder: nobody else takes that while it is stopped, as they may a port.
    """

    def __init__(self) -> None:
        # it refuses to be root's; the folder is short, as a socket's name must be, and its user's
        self._user: dict[str, Any] = {"user": "postgres", "group": "postgres"} if os.geteuid() == 0 else {}
        self._folder = Path(tempfile.mkdtemp(prefix="pg"))
        if self._user:
            shutil.chown(self._folder, **self._user)
        self._tool("initdb", "--auth=trust", "--username=owner", "--no-sync", "-D", f"{self._folder}/data")
        self.start()

    def start(self) -> None:
        """Begin to serve."""
        options = f"-k {self._folder} -c listen_addresses='' -c fsync=off"
        self._control("-l", f"{self._folder}/log", "-o", options, "start")

    def stop(self) -> None:
        """End at once, connections and all."""
        self._control("-m", "immediate", "stop")

    def url(self, role: str) -> str:
        """The database, as SQLAlchemy names it."""
        self.sql(f"CREATE ROLE {role} SUPERUSER LOGIN")
        return f"postgresql+psycopg://{role}@/postgres?host={self._folder}"

    def sql(self, text: str) -> str:
        """What it answers."""
        return self._tool("psql", "-h", str(self._folder), "-U", "owner", "-d", "postgres", "-Atc", text)

    def drop(self, role: str) -> None:
        """End the connections of a role."""
        self.sql(f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE usename = '{role}'")

    def close(self) -> None:
        """End it and remove what it kept."""
        with contextlib.suppress(subprocess.CalledProcessError):
            self.stop()
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Postgres:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _control(self, *arguments: str) -> None:
        self._tool("pg_ctl", "-w", "-t", f"{PATIENCE:g}", "-D", f"{self._folder}/data", *arguments)

    def _tool(self, name: str, *arguments: str) -> str:
        command = [f"{BINARIES}/{name}", *arguments]
        output: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        if name == "pg_ctl":  # what it starts keeps the pipe open
            output |= {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.run(command, check=True, cwd="/", **output, **self._user).stdout or ""


def until(true: Any) -> None:
    """Wait until `true()` is."""
    deadline = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < deadline, "it never came to be"
        time.sleep(0.05)
