"""A server's settings, and its files."""

import contextlib
import ipaddress
import os
import secrets
import shutil
from dataclasses import dataclass
from pathlib import Path

from cosim.errors import BadInput
from cosim.files import cannot, lock, prepare_folder, whole

TOKEN = "COSIM_TOKEN"  # the variable with the bearer token
DATABASE = "COSIM_DATABASE_URL"  # the variable with the database's URL
MB = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """The server's limits; sizes in bytes, times in s."""

    body: int = 1 * MB  # of a request, uploads apart
    upload: int = 64 * MB  # of an archive
    unpacked: int = 256 * MB  # of an archive's content
    files: int = 200  # in an archive
    uploads: int = 1000  # kept
    cells: int = 1000  # of a run
    simulated: float = 86_400.0  # of an episode, warm-up included
    queued: int = 1000  # runs that wait
    waiting: int = 16  # requests that wait, for each kind of long work
    sessions: int = 16  # open at once
    idle: float = 600.0  # until a session ends by itself
    check: float = 120.0  # to check a request
    memory: int = 8192 * MB  # address space of a process that simulates
    file: int = 512 * MB  # written by such a process
    disk: int = 8192 * MB  # written by all processes of a run, a session or a check with uploads
    free: int = 256 * MB  # left on the disk; with less a server is not ready
    tasks: int = 1024  # threads that a confined process adds to those of its user
    cpu: float = 900.0  # processor time of one episode, or between two resets of a session


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a server. `data` is absolute."""

    data: Path
    host: str = "127.0.0.1"
    port: int = 8000
    database: str | None = None  # URL; None: SQLite in `data`
    workers: int | None = None  # processes of runs; None: one per core
    engine: str = "local"
    ray_address: str | None = None
    token: str | None = None  # None: no authorisation
    limits: Limits = Limits()

    @property
    def runs(self) -> Path:
        """The folder of runs, with a folder per run."""
        return self.data / "runs"

    @property
    def uploads(self) -> Path:
        """The folder of uploads, with a folder per upload."""
        return self.data / "uploads"

    @property
    def scratch(self) -> Path:
        """Temporary files of confined processes."""
        return self.data / "scratch"

    @property
    def jobs_url(self) -> str:
        """The database of the list of runs."""
        return self.database or f"sqlite:///{self.data / 'service.sqlite'}"


def database(url: str | None, file: str | None) -> str | None:
    """The database's URL: `url`, or else the content of `file`, or else of the variable `DATABASE`.

    The variable is removed from the environment, so that the server's processes do not inherit it.

    Raises BadInput.
    """
    variable = os.environ.pop(DATABASE, "").strip()
    if file is None:
        return url or variable or None
    if url is not None:
        raise BadInput("excludes --database: give one of them", field="--database-file", value=file)
    with cannot("read", field="--database-file", value=file):
        found = Path(file).read_text("utf-8", "replace").strip()
    if not found:
        raise BadInput("contains no database URL", field="--database-file", value=file)
    return found


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server bound to `host`."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


class DataFolder(contextlib.AbstractContextManager["DataFolder"]):
    """The server's folder, created and locked until `close`.

    Raises BadInput: the folder cannot be created or written, or another server uses it.
    """

    def __init__(self, path: str) -> None:
        self.path = prepare_folder(path, "--data").absolute()
        self._lock = lock(self.path, "--data", path, "server")
        shutil.rmtree(self.path / "scratch", ignore_errors=True)  # of a server that was killed
        for name in ("runs", "uploads", "scratch"):
            (self.path / name).mkdir(exist_ok=True)

    def token(self, host: str) -> tuple[str | None, Path | None]:
        """The bearer token (None on loopback), and its file (None for the variable `TOKEN`).

        Without the variable, and unless `host` is loopback, the token is created at the first start, in a
        file that only its owner can read.
        """
        if given := os.environ.get(TOKEN, "").strip():
            return given, None
        if is_loopback(host):
            return None, None
        file = self.path / "token"
        if not file.exists():
            with whole(file) as draft:
                draft.touch(mode=0o600)
                draft.write_text(secrets.token_urlsafe(32) + "\n")
        return file.read_text().strip(), file

    def close(self) -> None:
        """Release the lock."""
        os.close(self._lock)

    def __exit__(self, *error: object) -> None:
        self.close()
