"""Registries on either database, and the servers of some tests: PostgreSQL from Debian, S3 from moto."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from services.registry.models import ModelRegistry
from tests.services.registry.stub_check import ALWAYS_READY

SERVER_STARTS_S = 300.0


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of packed models that several tests upload."""
    return tmp_path_factory.mktemp("uploads")


@pytest.fixture
def new_registry(tmp_path: Path, database_url: str | None) -> Iterator[Callable[..., ModelRegistry]]:
    """Return a function that opens the test's registry, repeatedly if needed; parametrised over databases."""
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
    """An empty registry on SQLite."""
    with ModelRegistry(tmp_path / "registry", check_program=ALWAYS_READY) as registry:
        yield registry


@pytest.fixture(scope="session")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Start an S3 server in a child process and return the registry options that use it."""
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
