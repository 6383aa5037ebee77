"""Database of the service: SQLite file by default, PostgreSQL by URL. Writers are serialised, each in a transaction.

The registry, the recordings and the jobs have separate tables and migrations (`Schema`).
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from alembic.config import Config
from alembic.runtime.environment import EnvironmentContext
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from services.errors import SchemaTooNew, StoreUnavailable

BUSY_TIMEOUT_S = 10.0
"""Seconds that a writer waits for the write lock of another process."""
INDEX_BYTES = 1 << 16
"""Free bytes on the disk below which an I/O error of SQLite is attributed to a full disk."""
_WRITERS_LOCK = 0x1_5B1A7
"""Key of the PostgreSQL advisory lock for writers; SQLite locks the file itself."""


@dataclass(frozen=True)
class Schema:
    """Tables of one package: folder of its migrations, and name of the table that records the applied migrations."""

    migrations: Path
    version_table: str


REGISTRY = Schema(Path(__file__).parent / "migrations", "alembic_version")


class Database:
    """Connections to one database, SQLite or PostgreSQL. Thread-safe."""

    def __init__(self, url: str, schema: Schema = REGISTRY) -> None:
        """Create the engine without connecting.

        Args:
            url: `sqlite:///PATH` or `postgresql://USER@HOST/NAME`.
            schema: tables to migrate.

        Raises:
            StoreUnavailable: if the URL is invalid or its driver is missing.
        """
        self._schema = schema
        try:
            self._url = _with_driver(sa.make_url(url))
            self._engine = _new_engine(self._url)
        except (ArgumentError, NoSuchModuleError, ModuleNotFoundError) as error:
            raise StoreUnavailable(
                f"the database cannot be opened: {error}; give sqlite:///PATH, or postgresql://… with the extra `postgresql`"
            ) from error

    @contextlib.contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """Provide a connection in autocommit mode, so each statement sees the newest committed state.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        with self._errors(), self._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            yield connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """Provide an exclusive write transaction; committed at the end of the block, rolled back on an exception.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        with self._errors(), self._engine.connect() as connection, connection.begin():
            if self._url.get_backend_name() == "postgresql":
                connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_WRITERS_LOCK)))
            yield connection

    def migrate(self) -> None:
        """Migrate the schema to this program's version, in one transaction.

        Raises:
            SchemaTooNew: if a later version of the program wrote the database.
            StoreUnavailable: if the database does not answer.
        """
        script = ScriptDirectory(self._schema.migrations, version_locations=[self._schema.migrations])
        table = self._schema.version_table
        with self.writing() as connection:
            current = MigrationContext.configure(connection, opts={"version_table": table}).get_current_heads()
            for revision in current:
                self._check_known(script, revision)
            if set(current) != set(script.get_heads()):
                with EnvironmentContext(
                    Config(), script, fn=lambda revision, _: script._upgrade_revs("head", revision)
                ) as run:
                    run.configure(connection, version_table=table, render_as_batch=True, transactional_ddl=True)
                    with run.begin_transaction():
                        run.run_migrations()

    def close(self) -> None:
        """Close all connections. Later use opens new ones."""
        self._engine.dispose()

    def _check_known(self, script: ScriptDirectory, revision: str) -> None:
        try:
            script.get_revision(revision)
        except CommandError as error:
            raise SchemaTooNew(
                f"the database {self} has schema {revision}, which this version of the program does not know (it knows up to"
                f" {', '.join(script.get_heads())}); start the version that wrote it, or restore a backup from before"
            ) from error

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (DBAPIError, PoolTimeout) as error:
            said = " ".join(str(getattr(error, "orig", None) or error).split())[:300]
            if self._disk_is_full(error):
                raise StoreUnavailable(
                    f"the database {self} cannot be written: its disk is full; free space"
                ) from error
            raise StoreUnavailable(
                f"the database {self} does not answer: {said}; check that it runs and may be written"
            ) from error

    def _disk_is_full(self, error: Exception) -> bool:
        """Return True if a full disk is the cause. SQLite reports a full disk as an I/O error where it cannot enlarge its
        index of the write-ahead log."""
        name = getattr(getattr(error, "orig", None), "sqlite_errorname", "")
        if name == "SQLITE_FULL":
            return True
        if not name.startswith("SQLITE_IOERR") or not self._url.database:
            return False
        with contextlib.suppress(OSError):
            return shutil.disk_usage(Path(self._url.database).parent).free < INDEX_BYTES
        return False

    def __str__(self) -> str:
        return self._url.render_as_string(hide_password=True)


def _with_driver(url: sa.URL) -> sa.URL:
    """Select the psycopg driver for every spelling of a PostgreSQL URL."""
    if url.drivername in ("postgres", "postgresql"):
        return url.set(drivername="postgresql+psycopg")
    if url.get_backend_name() not in ("sqlite", "postgresql"):
        raise ArgumentError(f"{url.drivername} is neither sqlite nor postgresql")
    return url


def _new_engine(url: sa.URL) -> sa.Engine:
    if url.get_backend_name() == "postgresql":
        return sa.create_engine(url, pool_pre_ping=True, connect_args={"connect_timeout": int(BUSY_TIMEOUT_S)})
    engine = sa.create_engine(url, connect_args={"timeout": BUSY_TIMEOUT_S, "isolation_level": None})
    sa.event.listen(engine, "connect", _prepare_sqlite)
    sa.event.listen(engine, "begin", _begin_sqlite)
    return engine


def _prepare_sqlite(connection: Any, _: object) -> None:
    """Set the SQLite pragmas. WAL allows readers during a write; FULL makes commits survive a power failure."""
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin_sqlite(connection: sa.Connection) -> None:
    """Take the write lock at the start of a transaction, so concurrent writers wait and do not fail later."""
    if connection.get_execution_options().get("isolation_level") != "AUTOCOMMIT":
        connection.exec_driver_sql("BEGIN IMMEDIATE")
