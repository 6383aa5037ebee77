from __future__ import annotations

import asyncio
import json
import os
import socket
import threading

import pytest

from services.bus.runtime import ProcessIdentity
from services.supervisor.launcher import (
    SOCKET,
    ByLauncher,
    Direct,
    Launcher,
    is_of_no_use,
    last_words,
    recorded_launcher,
)
from services.supervisor.worker import Parent


@pytest.fixture
def launcher(runtime):
    launcher = Launcher(runtime.path / SOCKET, Parent(None, 0.0))
    serving = threading.Thread(target=launcher.serve)
    serving.start()
    yield runtime.path / SOCKET
    launcher.stop()
    serving.join()
    assert not (runtime.path / SOCKET).exists()


def asked(path, data: bytes) -> dict:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(os.fspath(path))
        connection.sendall(data)
        return json.loads(connection.recv(1 << 16))


def test_launcher_answers_ping_and_status_over_socket(launcher):
    assert asked(launcher, b'{"command": "ping"}') == {"ok": True}
    assert asked(launcher, b'{"command": "status", "pid": 1}') == {"ok": True, "status": None}


@pytest.mark.parametrize(
    "data",
    [
        b"nonsense",
        b"[]",
        b'{"command": "status"}',
        b'{"command": "status", "pid": "x"}',
        b'{"command": "start"}',
        b'{"command": "start", "module": "os", "arguments": [], "environment": {}, "log": "/dev/null"}',
        b'{"command": "start", "module": "services.supervisor.engine", "arguments": 3, "environment": {}, "log": "/dev/null"}',
        b'{"command": "what"}',
    ],
    ids=repr,
)
def test_launcher_refuses_bad_requests_over_socket_and_continues(launcher, data):
    assert asked(launcher, data)["ok"] is False
    assert asked(launcher, b'{"command": "ping"}') == {"ok": True}


def test_launcher_ends_if_its_socket_is_removed(runtime):
    launcher = Launcher(runtime.path / SOCKET, Parent(None, 0.0))
    (runtime.path / SOCKET).unlink()
    launcher.serve()


def test_direct_start_has_own_session_log_and_exit_status(runtime):
    output = runtime.path / "log"

    async def run() -> str | None:
        start = Direct()
        pid = await start.start("this", [], output, {"PYTHONPATH": "", "X": "1"})
        identity = ProcessIdentity.of(pid)
        if identity is not None:
            assert os.getsid(pid) == pid != os.getsid(0)
            await identity.ended()
        return await start.how_ended(pid)

    how = asyncio.run(run())
    assert how == "exit code 0"
    assert "Zen" in output.read_text()
    assert last_words(output).startswith("Namespaces")
    assert not is_of_no_use(how) and is_of_no_use("exit code 2")


def test_by_launcher_close_is_idempotent(runtime):
    async def run() -> list[str]:
        start = ByLauncher(runtime)
        for stop in (False, True):
            await start.close(stop=stop)
        start.open()
        await start.close(stop=True)
        await asyncio.sleep(0)
        return [task.get_name() for task in asyncio.all_tasks() if task is not asyncio.current_task()]

    assert asyncio.run(run()) == []
    assert recorded_launcher(runtime) is None


def test_by_launcher_starts_process_directly_before_open(runtime):
    async def run() -> str | None:
        start = ByLauncher(runtime)
        pid = await start.start("services.supervisor.capture", ["--spec", "/none"], runtime.path / "log", {})
        identity = ProcessIdentity.of(pid)
        if identity is not None:
            await identity.ended()
        return await start.how_ended(pid)

    assert asyncio.run(run()) == "exit code 2"
    assert "/none cannot be read" in last_words(runtime.path / "log")
    assert recorded_launcher(runtime) is None


def test_engine_start_waits_for_loading_launcher_and_capture_does_not(runtime, monkeypatch):
    directly: list[str] = []

    async def start_directly(module, arguments, output, environment, *, fresh=False) -> int:
        directly.append(module)
        return 1

    async def by_the_launcher(command, **arguments) -> dict:
        return {"ok": True, "pid": 7}

    async def run() -> None:
        start = ByLauncher(runtime)
        start._keeping = asyncio.create_task(asyncio.sleep(600))
        monkeypatch.setattr(start._direct, "start", start_directly)
        monkeypatch.setattr(start, "_ask", by_the_launcher)
        engine, capture = (f"services.supervisor.{role}" for role in ("engine", "capture"))
        waiting = asyncio.create_task(start.start(engine, [], runtime.path / "log", {}))
        assert await start.start(capture, [], runtime.path / "log", {}) == 1
        assert await start.start(engine, [], runtime.path / "log", {}, fresh=True) == 1
        assert not waiting.done()
        start.ready.set()
        assert await waiting == 7
        assert directly == [capture, engine]
        start._keeping.cancel()

    asyncio.run(run())
