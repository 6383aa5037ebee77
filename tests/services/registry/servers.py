"""Empty databases on the PostgreSQL server of the tests."""

from __future__ import annotations

import time


def new_database(socket_folder: str) -> str:
    """Return the URL of a new schema as a database: its connections find and create tables there only.

    PostgreSQL copies about 300 files for a new database and none for a schema.
    """
    import psycopg

    name = f"test_{time.monotonic_ns()}"
    with psycopg.connect(f"host={socket_folder} user=tester dbname=postgres", autocommit=True) as connection:
        connection.execute(f"CREATE SCHEMA {name}")
    return f"postgresql://tester@/postgres?host={socket_folder}&options=-csearch_path%3D{name}"
