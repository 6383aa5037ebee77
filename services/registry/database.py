"""The service's database: SQLite in a file by default, PostgreSQL by URL. One writer at a time on either, in a transaction each.

The registry, the recordings and the jobs have tables of their own in it, each with its own row of migrations (`Schema`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import alembic.command
import alembic.config
import alembic.runtime.migration
import alembic.script
import sqlalchemy as sa
from alembic.util import CommandError
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from services.registry.errors import SchemaTooNew, StoreUnavailable

BUSY_TIMEOUT_S = 10.0
"""How long a writer waits for another one."""
_WRITERS_LOCK = 0x1_5B1A7
"""The advisory lock that writers to PostgreSQL take; SQLite has its own."""


@dataclass(frozen=True)
class Schema:
    """One package's tables: where its migrations lie, and the table that says which of them were made."""

    migrations: Path
    version_table: str


REGISTRY = Schema(Path(__file__).parent / "migrations", "alembic_version")


class Database:
    """Connections to the database. Any thread may use it."""

    def __init__(self, url: str, schema: Schema = REGISTRY) -> None:
        """url: `sqlite:///PATH` or `postgresql://USER@HOST/NAME`; nothing is connected yet. Raises StoreUnavailable for what cannot be one."""
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
        """A connection of which every statement sees what is committed at that moment. Raises StoreUnavailable."""
        with self._errors(), self._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            yield connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """A transaction of the only writer; committed to the disk at the end, undone by an exception. Raises StoreUnavailable."""
        with self._errors(), self._engine.connect() as connection, connection.begin():
            if self._url.get_backend_name() == "postgresql":
                connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_WRITERS_LOCK)))
            yield connection

    def migrate(self) -> None:
        """Bring the schema to this program's, in one transaction. Raises SchemaTooNew, StoreUnavailable."""
        config = alembic.config.Config()
        config.set_main_option("script_location", str(self._schema.migrations).replace("%", "%%"))
        options = {"version_table": self._schema.version_table}
        with self.writing() as connection:
            context = alembic.runtime.migration.MigrationContext.configure(connection, opts=options)
            current = context.get_current_heads()
            script = alembic.script.ScriptDirectory.from_config(config)
            for revision in current:
                self._check_known(script, revision)
            if set(current) != set(script.get_heads()):
                config.attributes.update(connection=connection, **options)
                alembic.command.upgrade(config, "head")

    def close(self) -> None:
        """Close every connection; the next use opens new ones."""
        self._engine.dispose()

    def _check_known(self, script: alembic.script.ScriptDirectory, revision: str) -> None:
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
            raise StoreUnavailable(
                f"the database {self} does not answer: {said}; check that it runs and may be written"
            ) from error

    def __str__(self) -> str:
        return self._url.render_as_string(hide_password=True)


def _with_driver(url: sa.URL) -> sa.URL:
    """PostgreSQL through psycopg, whichever way the URL is written."""
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
    """WAL: readers go on beside the writer. FULL: what was committed survives a power cut."""
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin_sqlite(connection: sa.Connection) -> None:
    """Take the writer's place at once, so that two writers wait for each other in place of failing later."""
    if connection.get_execution_options().get("isolation_level") != "AUTOCOMMIT":
        connection.exec_driver_sql("BEGIN IMMEDIATE")
