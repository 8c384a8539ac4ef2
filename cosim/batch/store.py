"""The store of a run's rows: exactly one row per episode, written at once, safe against kills.

By default SQLite in the run's folder (the write-ahead log makes rows atomic, even under kill -9), or any
database of SQLAlchemy by URL. A database may hold many runs, each under its name.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, IntegrityError, SQLAlchemyError

from cosim.errors import BadInput, CosimError, extra

FILE = "store.sqlite"
_NAME = sa.String(200)

# `version` of a set of tables rises when their columns change.
TABLES = _tables = sa.MetaData(info={"part": "rows", "version": 1})
_runs = sa.Table(
    "cosim_runs",
    _tables,
    sa.Column("run", _NAME, primary_key=True),
    sa.Column("spec_hash", sa.String(64), nullable=False),
    sa.Column("document", sa.JSON, nullable=False),  # spec, seeds, versions, command
)
_cells = sa.Table(
    "cosim_cells",
    _tables,
    sa.Column("run", _NAME, primary_key=True),
    sa.Column("cell", sa.String(32), primary_key=True),
    sa.Column("place", sa.Integer, nullable=False),  # in the matrix
    sa.Column("case", sa.JSON, nullable=False),
    sa.Column("manifest", sa.JSON, nullable=False),
)
_episodes = sa.Table(
    "cosim_episodes",
    _tables,
    sa.Column("run", _NAME, primary_key=True),
    sa.Column("key", sa.String(64), primary_key=True),  # Case.key
    sa.Column("cell", sa.String(32), nullable=False),
    sa.Column("seed", sa.BigInteger, nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("trace_hash", sa.String(64)),
    sa.Column("row", sa.JSON, nullable=False),  # every column of `cosim.batch.records`
)
_schemas = sa.Table(
    "cosim_schemas",
    sa.MetaData(),
    sa.Column("part", sa.String(32), primary_key=True),
    sa.Column("version", sa.Integer, nullable=False),
)
_UNVERSIONED = 1  # version of tables without an entry in `_schemas`
# How soon libpq notices that a connection is lost: s, s, s, number, ms.
_LIBPQ = {"connect_timeout": 10, "keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3}
_LIBPQ |= {"tcp_user_timeout": 10_000}


class Store(contextlib.AbstractContextManager["Store"]):
    """The rows of one run. One process writes (`cosim.batch.folder` sees to that).

    Raises:
        BadInput: the database cannot be reached or written, before anything is kept.
        CosimError: it cannot be written any more (disk full): stored rows are complete, --resume continues.
    """

    def __init__(self, url: str, run: str = "") -> None:
        self.run = run  # its name in the database
        self._url = url
        self._engine = connect(url, _tables)

    @classmethod
    def in_folder(cls, folder: Path, url: str | None = None) -> Store:
        """The store of a run folder: one SQLite file, or the database `url`, by the folder's name in it."""
        if url is not None:
            return cls(url, folder.absolute().name)
        return cls(f"sqlite:///{folder.absolute() / FILE}")

    def begin(self, spec_hash: str, document: Mapping[str, Any], cells: Sequence[Mapping[str, Any]]) -> None:
        """Store the plan. `cells`: `cell`, `case` and `manifest`, in the matrix's order."""
        rows = [{"run": self.run, "place": i, **cell} for i, cell in enumerate(cells)]
        with self._writing() as connection:
            connection.execute(
                _runs.insert().values(run=self.run, spec_hash=spec_hash, document=dict(document))
            )
            if rows:
                connection.execute(_cells.insert(), rows)

    def extend(self, cells: Sequence[Mapping[str, Any]]) -> None:
        """Append further cells, as in `begin`; known cells are unchanged."""
        known = self.cells()
        new = [cell for cell in cells if cell["cell"] not in known]
        rows = [{"run": self.run, "place": len(known) + i, **cell} for i, cell in enumerate(new)]
        if rows:
            with self._writing() as connection:
                connection.execute(_cells.insert(), rows)

    def spec_hash(self) -> str | None:
        """The hash of this run's plan; None before `begin`."""
        found = self._read(sa.select(_runs.c.spec_hash).where(_runs.c.run == self.run))
        return found[0].spec_hash if found else None

    def document(self) -> dict[str, Any]:
        """The document passed to `begin`."""
        return dict(self._read(sa.select(_runs.c.document).where(_runs.c.run == self.run))[0].document)

    def cells(self) -> dict[str, dict[str, Any]]:
        """Cell -> its `case` and `manifest`, in the matrix's order."""
        query = sa.select(_cells).where(_cells.c.run == self.run).order_by(_cells.c.place)
        return {row.cell: {"case": row.case, "manifest": row.manifest} for row in self._read(query)}

    def set_manifest(self, cell: str, manifest: Mapping[str, Any]) -> None:
        """Store the manifest of a cell's episodes, as reported by the workers."""
        here = (_cells.c.run == self.run) & (_cells.c.cell == cell)
        with self._writing() as connection:
            connection.execute(_cells.update().where(here).values(manifest=dict(manifest)))

    def note(self, name: str, value: Any, spec_hash: str | None = None) -> None:
        """Set one field of the document, and optionally the hash."""
        values = {"document": {**self.document(), name: value}, "spec_hash": spec_hash or self.spec_hash()}
        with self._writing() as connection:
            connection.execute(_runs.update().where(_runs.c.run == self.run).values(**values))

    def keys(self) -> set[str]:
        """Keys of the finished episodes."""
        return {row.key for row in self._read(sa.select(_episodes.c.key).where(_episodes.c.run == self.run))}

    def add(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Store these rows, all or none. Raises CosimError for an existing row."""
        values = [
            {
                "run": self.run,
                "key": row["key"],
                "cell": row["cell"],
                "seed": row["seed"],
                "status": row["status"],
                "trace_hash": row.get("trace_hash"),
                "row": dict(row),
            }
            for row in rows
        ]
        if values:
            with self._writing() as connection:
                connection.execute(_episodes.insert(), values)

    def rows(self) -> list[dict[str, Any]]:
        """Every row, ordered by cell and seed."""
        query = (
            sa.select(_episodes.c.row)
            .join(_cells, (_cells.c.run == _episodes.c.run) & (_cells.c.cell == _episodes.c.cell))
            .where(_episodes.c.run == self.run)
            .order_by(_cells.c.place, _episodes.c.seed)
        )
        return [dict(found.row) for found in self._read(query)]

    def remove(self) -> None:
        """Delete this run; other runs in a database remain."""
        with self._writing() as connection:
            for table in (_episodes, _cells, _runs):
                connection.execute(table.delete().where(table.c.run == self.run))

    def close(self) -> None:
        """Close the database connection."""
        self._engine.dispose()

    def __exit__(self, *error: object) -> None:
        self.close()

    # ---- inside ----

    @property
    def _shown(self) -> str:
        """The URL without its password."""
        return shown(self._url)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[sa.Connection]:
        """One transaction; database errors become one sentence."""
        try:
            with self._engine.begin() as connection:
                yield connection
        except IntegrityError as error:
            problem = f"an episode is stored already: {_first_line(error)}"
            raise CosimError(f"{self._shown}: {problem}") from None
        except SQLAlchemyError as error:
            problem = f"cannot write: {_first_line(error)} (--resume continues from here)"
            raise CosimError(f"{self._shown}: {problem}") from None

    def _read(self, query: sa.Select[Any]) -> list[sa.Row[Any]]:
        with self._engine.connect() as connection:
            return [*connection.execute(query)]


def connect(url: str, tables: sa.MetaData, field: str = "--store") -> sa.Engine:
    """The database `url` with these tables in it.

    Raises BadInput (naming `field`): it cannot be reached, or holds them in another version.
    """
    try:
        libpq = sa.engine.make_url(url).get_dialect().driver in ("psycopg", "psycopg2")
        with extra("postgresql", field=field, value=shown(url)):
            # pre_ping: a pooled connection may have been lost
            engine = sa.create_engine(url, pool_pre_ping=True, connect_args=_LIBPQ if libpq else {})
        if engine.dialect.name == "sqlite":
            sa.event.listen(engine, "connect", _sqlite)
        found, needed = _version(engine, tables), tables.info["version"]
        if found != needed:
            engine.dispose()
            age = "an older" if found < needed else "a newer"
            problem = f"its tables are from {age} cosim: version {found}, this cosim needs {needed}"
            raise BadInput(problem, field=field, value=shown(url))
        tables.create_all(engine)
    except ArgumentError:
        masked = re.sub(r"://.*@", "://***@", url)
        raise BadInput("is no database URL", field=field, value=masked) from None
    except SQLAlchemyError as error:
        raise BadInput(_first_line(error), field=field, value=shown(url)) from None
    return engine


def _version(engine: sa.Engine, tables: sa.MetaData) -> int:
    """The version of these tables in a database; without any, the version of `tables` is entered."""
    there = {*sa.inspect(engine).get_table_names()}
    if there.isdisjoint(tables.tables):
        _schemas.create(engine, checkfirst=True)
        with (
            contextlib.suppress(IntegrityError),
            engine.begin() as connection,
        ):  # another process may do the same
            connection.execute(_schemas.insert().values(**tables.info))
    elif _schemas.name not in there:
        return _UNVERSIONED
    with engine.connect() as connection:
        noted = sa.select(_schemas.c.version).where(_schemas.c.part == tables.info["part"])
        found = connection.execute(noted).scalar()
    return _UNVERSIONED if found is None else int(found)


def shown(url: str) -> str:
    """The URL without its password."""
    return sa.engine.make_url(url).render_as_string(hide_password=True)


def _sqlite(connection: Any, _: object) -> None:
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=NORMAL")  # complete after kill -9; a power cut may lose the last rows
    cursor.execute("PRAGMA busy_timeout=30000")  # ms
    cursor.close()


def _first_line(error: SQLAlchemyError) -> str:
    text = str(getattr(error, "orig", None) or error).strip()
    return text.splitlines()[0] if text else type(error).__name__
