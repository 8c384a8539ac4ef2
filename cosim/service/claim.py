"""Exclusive ownership of a PostgreSQL database's runs: one server at a time, across reconnections.

A PostgreSQL lock, released with its connection, permits driving. The row of `cosim_claim` names the last
server that held the lock; writes of another server are refused.
"""

from __future__ import annotations

import contextlib
import time

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from cosim.batch.store import shown
from cosim.errors import BadInput
from cosim.service.ids import new_id
from cosim.service.problems import Refused

LOCK = int.from_bytes(b"cosim")  # number of the advisory lock
CLAIM_TIMEOUT = 5.0  # s until the database notices a killed server
LOOKS = 1.0  # s between checks of the lock
STOP_DELAY = 5.0  # s until a server without the lock notices and stops

_claims = sa.Table(
    "cosim_claim",
    sa.MetaData(),
    sa.Column("lock", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("server", sa.String(32)),  # None: the last server shut down properly
)


class Superseded(Refused):
    """Another server drives the runs of this database."""

    status = 503


class Claim:
    """This server's claim on the runs, until `close`. Raises BadInput if another server has the claim."""

    def __init__(self, engine: sa.Engine, url: str) -> None:
        self._engine, self._name = engine, new_id()
        self._connection: sa.Connection | None = None
        self._term = 0  # number of takeovers from another server
        self.drives_from = 0.0  # time.monotonic(), from which no other server drives
        _claims.create(engine, checkfirst=True)
        deadline = time.monotonic() + CLAIM_TIMEOUT
        while not self.take():
            if time.monotonic() > deadline:
                raise BadInput("another server is working in it", field="--database", value=shown(url))
            time.sleep(0.1)

    def take(self) -> bool:
        """Try to take the lock; returns whether this server has the lock. Raises SQLAlchemyError."""
        connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        try:
            if not connection.execute(sa.select(sa.func.pg_try_advisory_lock(LOCK))).scalar_one():
                connection.close()
                return False
            before = self._noted(connection)
            if before != self._name:
                self._note(connection, self._name)
                self._term += 1
                self.drives_from = 0.0 if before is None else time.monotonic() + STOP_DELAY
        except BaseException:
            connection.invalidate()  # releases the lock
            connection.close()
            raise
        self._connection = connection
        return True

    def keep(self) -> bool:
        """Whether this server has held the claim without a gap in which another server may have driven.

        Takes a lock again that was lost with its connection.
        """
        if self._connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                self._connection.execute(sa.select(1))
                return True
            self._let_go()
        term = self._term
        with contextlib.suppress(SQLAlchemyError):
            return self.take() and self._term == term
        return False

    @property
    def held(self) -> bool:
        """Whether this server had the lock at the last check."""
        return self._connection is not None

    def check(self, connection: sa.Connection) -> None:
        """Lock the claim until the transaction ends. Raises Superseded if another server has claimed it."""
        if self._noted(connection) != self._name:
            raise Superseded("another server drives the runs of this database")

    def close(self) -> None:
        """Release the database to another server."""
        if self._connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                self._note(self._connection, None)
            self._let_go()

    # ---- inside ----

    def _noted(self, connection: sa.Connection) -> str | None:
        """The server named in the row, which is locked until the transaction ends."""
        query = sa.select(_claims.c.server).where(_claims.c.lock == LOCK).with_for_update(read=True)
        found: str | None = connection.execute(query).scalar()
        return found

    def _note(self, connection: sa.Connection, server: str | None) -> None:
        here = _claims.update().where(_claims.c.lock == LOCK).values(server=server)
        if not connection.execute(here).rowcount:
            connection.execute(_claims.insert().values(lock=LOCK, server=server))

    def _let_go(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                connection.invalidate()
                connection.close()
