"""Registries on either database, and the servers that some tests need: PostgreSQL from Debian's package, S3 from PyPI's moto."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from services.registry.models import ModelRegistry
from tests.services.registry.servers import new_database
from tests.services.registry.stub_check import ALWAYS_READY

SERVER_STARTS_S = 30.0


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where packed models lie that several tests upload."""
    return tmp_path_factory.mktemp("uploads")


@pytest.fixture(scope="session")
def postgresql() -> Iterator[str]:
    """A PostgreSQL server without a port of its own: the folder of its socket."""
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
    if not programs:
        pytest.skip("PostgreSQL is not installed (apt-get install postgresql)")
    user = None
    if os.geteuid() == 0:  # the server refuses to run as root
        try:
            user = pwd.getpwnam("postgres").pw_name
        except KeyError:
            pytest.skip("there is no user postgres to run PostgreSQL as")
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    try:
        if user is not None:
            shutil.chown(folder, user)
        subprocess.run(
            [programs[-1].with_name("initdb"), "-D", folder / "data", "-U", "tester", "-A", "trust", "-E", "UTF8"],
            user=user, cwd=folder, check=True, capture_output=True,
        )  # fmt: skip
        options = ["-c", "listen_addresses=", "-c", "fsync=off", "-k", str(folder)]
        with open(folder / "log", "wb") as log:
            server = subprocess.Popen(
                [programs[-1], "-D", folder / "data", *options], user=user, cwd=folder, stdout=log, stderr=log
            )
        try:
            _wait_for(server, lambda: _answers_postgresql(folder))
            yield str(folder)
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(SERVER_STARTS_S)
    finally:
        shutil.rmtree(folder)


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest) -> str | None:
    """None for SQLite in the registry's folder; the URL of an empty database of PostgreSQL."""
    if request.param == "sqlite":
        return None
    return new_database(request.getfixturevalue("postgresql"))


@pytest.fixture
def new_registry(tmp_path: Path, database_url: str | None) -> Iterator[Callable[..., ModelRegistry]]:
    """Open the test's registry, again and again if wanted, on each database in turn."""
    opened = []

    def new(**options: Any) -> ModelRegistry:
        given = {"database_url": database_url, "check_program": ALWAYS_READY, **options}
        opened.append(ModelRegistry(tmp_path / "registry", **given))
        return opened[-1]

    yield new
    for registry in opened:
        registry.close()


@pytest.fixture
def registry(new_registry: Callable[..., ModelRegistry]) -> ModelRegistry:
    """An empty registry."""
    return new_registry()


@pytest.fixture
def sqlite_registry(tmp_path: Path) -> Iterator[ModelRegistry]:
    """An empty registry where the database does not matter."""
    with ModelRegistry(tmp_path / "registry", check_program=ALWAYS_READY) as registry:
        yield registry


def _answers_postgresql(folder: Path) -> bool:
    import psycopg

    try:
        psycopg.connect(f"host={folder} user=tester dbname=postgres").close()
    except psycopg.OperationalError:
        return False
    return True


def _wait_for(server: subprocess.Popen[bytes], answers: Callable[[], bool]) -> None:
    until = time.monotonic() + SERVER_STARTS_S
    while not answers():
        assert server.poll() is None, f"the server ended with {server.returncode}"
        assert time.monotonic() < until, f"the server did not answer within {SERVER_STARTS_S:g} s"
        time.sleep(0.1)


@pytest.fixture(scope="session")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """A server that speaks S3, in a process of its own: the options of a registry that keeps its files there."""
    pytest.importorskip("moto", reason="moto is not installed (extra `dev`)")
    pytest.importorskip("s3fs", reason="s3fs is not installed (extra `s3`)")
    log = tmp_path_factory.mktemp("s3") / "log"
    code = (
        "from moto.server import ThreadedMotoServer as Server; import time\n"
        "server = Server('127.0.0.1', 0, verbose=False); server.start(); print(server.get_host_and_port()[1], flush=True); time.sleep(3600)"
    )
    with open(log, "wb") as said:
        server = subprocess.Popen(
            [sys.executable, "-c", code],
            stdout=subprocess.PIPE, stderr=said,
        )  # fmt: skip
    try:
        assert server.stdout is not None
        port = server.stdout.readline().strip().decode()
        assert port, log.read_text()
        yield {"endpoint_url": f"http://127.0.0.1:{port}"}
    finally:
        server.kill()
        server.wait()
        server.stdout.close()
