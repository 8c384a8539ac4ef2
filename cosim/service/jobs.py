"""The list of runs: requests and progress, kept in the database so that a restart continues."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from cosim.batch.store import connect
from cosim.service.claim import Claim

QUEUED, RUNNING, FINISHED, CANCELLED, FAILED = STATUSES = (
    "queued",
    "running",
    "finished",
    "cancelled",
    "failed",
)
OPEN = (QUEUED, RUNNING)

# `version` rises when their columns change.
_tables = sa.MetaData(info={"part": "runs", "version": 1})
_jobs = sa.Table(
    "cosim_jobs",
    _tables,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("run", sa.String(32), nullable=False, unique=True),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("request", sa.JSON, nullable=False),  # as it was sent
    sa.Column("uploads", sa.JSON, nullable=False),  # the uploads that it uses
    sa.Column("episodes", sa.Integer, nullable=False),
    sa.Column("done", sa.Integer, nullable=False),  # finished episodes, at the last update
    sa.Column("created", sa.String(32), nullable=False),
    sa.Column("began", sa.String(32)),
    sa.Column("ended", sa.String(32)),
    sa.Column("error", sa.Text),
)


@dataclass(frozen=True, slots=True)
class Job:
    """One run as the list has it; times are UTC, ISO 8601."""

    number: int  # in the order of submission
    run: str  # id
    name: str
    status: str  # one of STATUSES
    request: dict[str, Any]
    uploads: list[str]
    episodes: int
    done: int
    created: str
    began: str | None
    ended: str | None
    error: str | None


class Jobs:
    """The list. Raises BadInput (`--database`): the database cannot be reached, or another server has it.

    A PostgreSQL database is claimed until `close` (`claim`); SQLite is in a locked folder. Writing methods
    raise Superseded if another server has claimed the database.
    """

    def __init__(self, url: str) -> None:
        self._engine = connect(url, _tables, "--database")
        self.claim: Claim | None = None
        if self._engine.dialect.name == "postgresql":
            try:
                self.claim = Claim(self._engine, url)
            except BaseException:
                self._engine.dispose()
                raise

    def add(self, run: str, name: str, request: dict[str, Any], uploads: Sequence[str], episodes: int) -> Job:
        """Add a queued run."""
        values: dict[str, Any] = {
            "run": run,
            "name": name,
            "status": QUEUED,
            "request": request,
            "uploads": [*uploads],
        }
        values |= {"episodes": episodes, "done": 0, "created": now()}
        with self._writing() as connection:
            connection.execute(_jobs.insert().values(**values))
        found = self.get(run)
        assert found is not None
        return found

    def set(self, run: str, **values: Any) -> None:
        """Change these columns of one run."""
        with self._writing() as connection:
            connection.execute(_jobs.update().where(_jobs.c.run == run).values(**values))

    def remove(self, run: str) -> None:
        """Delete a run."""
        with self._writing() as connection:
            connection.execute(_jobs.delete().where(_jobs.c.run == run))

    def get(self, run: str) -> Job | None:
        """One run; None for an unknown id."""
        found = self._read(sa.select(_jobs).where(_jobs.c.run == run))
        return found[0] if found else None

    def open(self) -> list[Job]:
        """Running and waiting runs, oldest first."""
        return self._read(sa.select(_jobs).where(_jobs.c.status.in_(OPEN)).order_by(_jobs.c.number))

    def all(self, status: str | None = None) -> list[Job]:
        """Every run (of one status), the newest first."""
        query = sa.select(_jobs).order_by(_jobs.c.number.desc())
        return self._read(query if status is None else query.where(_jobs.c.status == status))

    def counts(self) -> dict[str, int]:
        """Number of runs by status."""
        query = sa.select(_jobs.c.status, sa.func.count()).group_by(_jobs.c.status)
        with self._engine.connect() as connection:
            found = {status: int(n) for status, n in connection.execute(query)}
        return {status: found.get(status, 0) for status in STATUSES}

    def problem(self) -> str | None:
        """The reason why this server cannot drive its runs now; None if it can. Raises SQLAlchemyError."""
        self.counts()
        return None if self.claim is None or self.claim.held else "another server may drive its runs"

    def close(self) -> None:
        """Close the database connection."""
        if self.claim is not None:
            self.claim.close()
        self._engine.dispose()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[sa.Connection]:
        with self._engine.begin() as connection:
            if self.claim is not None:
                self.claim.check(connection)
            yield connection

    def _read(self, query: sa.Select[Any]) -> list[Job]:
        with self._engine.connect() as connection:
            return [Job(**row._mapping) for row in connection.execute(query)]


def now() -> str:
    """The present time in UTC, ISO 8601 with seconds."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
