"""Which server drives the runs of a PostgreSQL database: one at a time, however connections come and go.

A lock of PostgreSQL's says who may drive; it is gone as soon as the connection is that took it. The row of
`cosim_claim` names the last server that held it: whoever writes as another one is refused.
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

LOCK = int.from_bytes(b"cosim")  # PostgreSQL's number of it
CLAIMING = 5.0  # s that the database may take to notice the end of a server that was killed
LOOKS = 1.0  # s between looks whether the lock is still held
STOPPING = 5.0  # s that a server without the lock may take to look and to stop

_claims = sa.Table(
    "cosim_claim",
    sa.MetaData(),
    sa.Column("lock", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("server", sa.String(32)),  # None: the last one ended in order
)


class Superseded(Refused):
    """Another server drives the runs of this database."""

    status = 503


class Claim:
    """This server's, until `close`. Raises BadInput (`--database`): another server has it."""

    def __init__(self, engine: sa.Engine, url: str) -> None:
        self._engine, self._name = engine, new_id()
        self._connection: sa.Connection | None = None
        self._term = 0  # how often it was taken from another server
        self.drives_from = 0.0  # time.monotonic() from which nobody else drives any more
        _claims.create(engine, checkfirst=True)
        deadline = time.monotonic() + CLAIMING
        while not self.take():
            if time.monotonic() > deadline:
                raise BadInput("another server is working in it", field="--database", value=shown(url))
            time.sleep(0.1)

    def take(self) -> bool:
        """Whether this server has the lock now, where nobody else has it. Raises SQLAlchemyError."""
        connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        try:
            if not connection.execute(sa.select(sa.func.pg_try_advisory_lock(LOCK))).scalar_one():
                connection.close()
                return False
            before = self._noted(connection)
            if before != self._name:
                self._note(connection, self._name)
                self._term += 1
                self.drives_from = 0.0 if before is None else time.monotonic() + STOPPING
        except BaseException:
            connection.invalidate()  # and with it the lock
            connection.close()
            raise
        self._connection = connection
        return True

    def keep(self) -> bool:
        """Whether it was this server's without a gap in which another one may have driven.

        A lock that was lost with its connection is taken again.
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
        """Whether the lock was this server's when it was last looked."""
        return self._connection is not None

    def check(self, connection: sa.Connection) -> None:
        """Have the transaction fail unless no other server has claimed the database before its end.

        Raises Superseded.
        """
        if self._noted(connection) != self._name:
            raise Superseded("another server drives the runs of this database")

    def close(self) -> None:
        """Leave it to another server."""
        if self._connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                self._note(self._connection, None)
            self._let_go()

    # ---- inside ----

    def _noted(self, connection: sa.Connection) -> str | None:
        """The server that the row names; nobody changes it before the transaction ends."""
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
