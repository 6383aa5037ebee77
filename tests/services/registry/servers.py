"""New, empty databases on the PostgreSQL server of the tests."""

from __future__ import annotations

import time


def new_database(socket_folder: str) -> str:
    """The URL of a new, empty database."""
    import psycopg

    with psycopg.connect(f"host={socket_folder} user=tester dbname=postgres", autocommit=True) as connection:
        name = f"test_{time.monotonic_ns()}"
        connection.execute(f"CREATE DATABASE {name}")
    return f"postgresql://tester@/{name}?host={socket_folder}"
