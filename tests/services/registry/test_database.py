"""The database: migration at start, exclusive writers, newer schemas, error messages."""

import shutil
import sqlite3
import threading
from types import SimpleNamespace

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from services.errors import SchemaTooNew, StoreUnavailable
from services.registry.database import Database
from services.registry.models import ModelRegistry
from services.registry.records import METADATA, MODELS
from tests.services.registry.servers import new_database


@pytest.fixture
def database(database_url, tmp_path):
    opened = Database(database_url or f"sqlite:///{tmp_path / 'registry.sqlite'}")
    yield opened
    opened.close()


def test_registry_migrations_create_tables_of_metadata(database):
    database.migrate()
    with database.reading() as connection:
        assert compare_metadata(MigrationContext.configure(connection), METADATA) == []


def test_second_migration_keeps_data(database):
    database.migrate()
    with database.writing() as connection:
        connection.execute(sa.insert(MODELS).values(name="liver", created_at="now", last_version=0))
    database.migrate()
    with database.reading() as connection:
        assert connection.execute(sa.select(MODELS.c.name)).scalars().all() == ["liver"]


def test_concurrent_migrations_succeed(database):
    errors = []

    def migrate():
        try:
            database.migrate()
        except StoreUnavailable as error:
            errors.append(error)

    threads = [threading.Thread(target=migrate) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_migrate_raises_for_newer_schema_and_changes_nothing(database):
    database.migrate()
    with database.writing() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '0999'"))
    with pytest.raises(
        SchemaTooNew, match=r"has schema 0999, which this version .* \(it knows up to 0001\); start the version"
    ):
        database.migrate()
    with database.reading() as connection:
        assert connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar() == "0999"


def test_failed_transaction_is_rolled_back(database):
    database.migrate()
    with pytest.raises(ZeroDivisionError), database.writing() as connection:
        connection.execute(sa.insert(MODELS).values(name="liver", created_at="now", last_version=0))
        raise ZeroDivisionError
    with database.reading() as connection:
        assert connection.execute(sa.select(MODELS)).all() == []


def test_second_database_writer_waits_for_first(database):
    database.migrate()
    order = []
    started = threading.Event()

    def second():
        started.set()
        with database.writing():
            order.append("second")

    with database.writing():
        thread = threading.Thread(target=second)
        thread.start()
        assert started.wait(300)
        thread.join(0.3)
        order.append("first")
    thread.join()
    assert order == ["first", "second"]


def test_sqlite_uses_wal_and_allows_reads_during_write(tmp_path):
    database = Database(f"sqlite:///{tmp_path / 'a.sqlite'}")
    with database.reading() as connection:
        asked = [
            connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys")
        ]
    assert asked == ["wal", 2, 1]
    database.migrate()
    with database.writing(), database.reading() as connection:
        assert connection.execute(sa.select(MODELS)).all() == []
    database.close()


def test_registry_raises_for_file_that_is_not_sqlite(tmp_path):
    (tmp_path / "registry.sqlite").write_bytes(b"something else entirely" * 100)
    with pytest.raises(StoreUnavailable, match=r"registry\.sqlite does not answer: file is not a database"):
        ModelRegistry(tmp_path)


def test_database_error_names_server_without_password():
    database = Database("postgresql://somebody:secret@127.0.0.1:1/registry")
    with pytest.raises(StoreUnavailable, match=r"somebody:\*\*\*@127\.0\.0\.1.*does not answer") as raised:
        database.migrate()
    assert "secret" not in str(raised.value)


@pytest.mark.parametrize("url", ["", "nonsense", "mysql://host/x", "oracle://host/x", "nothing://x"])
def test_database_raises_for_unsupported_url(url):
    with pytest.raises(StoreUnavailable, match="cannot be opened"):
        Database(url)


def test_connection_closed_by_postgresql_is_reopened(postgresql):
    url = new_database(postgresql)
    database, other = Database(url), Database(url)
    database.migrate()
    with other.writing() as connection:
        mine = sa.text(
            "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity WHERE pid <> pg_backend_pid() AND datname = current_database()"
        )
        assert connection.execute(mine).scalar() == 1
    with database.reading() as connection:
        assert connection.execute(sa.select(MODELS)).all() == []
    database.close()
    other.close()


def test_full_disk_raises_store_unavailable_with_advice(tmp_path):
    database = Database(f"sqlite:///{tmp_path / 'registry.sqlite'}")
    with pytest.raises(StoreUnavailable, match="its disk is full; free space"), database.writing() as connection:
        connection.exec_driver_sql("PRAGMA max_page_count = 1")
        connection.exec_driver_sql("CREATE TABLE more (name TEXT)")
    database.close()


@pytest.mark.parametrize(("free", "said"), [(4096, "its disk is full; free space"), (1 << 30, "check that it runs")])
def test_disk_io_error_is_reported_as_full_disk_only_without_free_space(tmp_path, monkeypatch, free, said):
    database = Database(f"sqlite:///{tmp_path / 'registry.sqlite'}")
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    cause = sqlite3.OperationalError("disk I/O error")
    cause.sqlite_errorname = "SQLITE_IOERR_SHMSIZE"
    with pytest.raises(StoreUnavailable, match=said), database.reading():
        raise sa.exc.OperationalError("SELECT", {}, cause)
    database.close()
