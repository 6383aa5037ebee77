"""Notifications to systemd: ready, watchdog, stopping; none without a socket."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.api.server import ServiceManager

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def manager() -> Iterator[tuple[socket.socket, str]]:
    """A notification socket as systemd provides it, and its address."""
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(f"{folder}/notify")
        heard.settimeout(300)
        yield heard, f"{folder}/notify"


def test_service_manager_without_socket_sends_nothing():
    alone = ServiceManager({})
    alone.tell("READY=1")
    assert alone.feed_s is None
    asyncio.run(alone.feed_watchdog())


def test_service_manager_removes_its_environment_variables(manager):
    environment = {"NOTIFY_SOCKET": manager[1], "WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid()), "A": "b"}
    assert ServiceManager(environment).feed_s == 15.0
    assert environment == {"A": "b"}


@pytest.mark.parametrize("wrong", [{"WATCHDOG_PID": "1"}, {"WATCHDOG_USEC": "soon"}, {"NOTIFY_SOCKET": ""}])
def test_feed_s_is_none_for_watchdog_of_other_process_or_bad_values(manager, wrong):
    environment = {"NOTIFY_SOCKET": manager[1], "WATCHDOG_USEC": "1000", "WATCHDOG_PID": str(os.getpid())}
    assert ServiceManager({**environment, **wrong}).feed_s is None


def test_service_manager_sends_to_abstract_socket():
    name = f"intrasplat-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(f"\0{name}")
        heard.settimeout(300)
        ServiceManager({"NOTIFY_SOCKET": f"@{name}"}).tell("READY=1", "STATUS=serving")
        assert heard.recv(100) == b"READY=1\nSTATUS=serving"


def test_service_manager_logs_missing_socket(caplog):
    ServiceManager({"NOTIFY_SOCKET": "/nowhere/notify"}).tell("READY=1")
    assert "systemd was not notified of READY=1" in caplog.text


def test_watchdog_is_fed_only_while_event_loop_runs(manager):
    heard, address = manager

    async def served() -> None:
        feeding = asyncio.create_task(
            ServiceManager({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "20000"}).feed_watchdog()
        )
        heard.setblocking(False)
        drained = 0
        while drained < 3:
            await asyncio.sleep(0.005)
            drained += bool(_received(heard))
        while _received(heard):
            pass
        time.sleep(0.2)  # the loop stands still
        assert not _received(heard)
        feeding.cancel()

    asyncio.run(asyncio.wait_for(served(), 300))


def _received(heard: socket.socket) -> bytes:
    try:
        return heard.recv(100)
    except BlockingIOError:
        return b""


@pytest.mark.slow
def test_serve_notifies_systemd_of_ready_watchdog_and_stopping(manager, tmp_path):
    heard, address = manager
    process = subprocess.Popen(
        [sys.executable, "-m", "services.cli", "serve", "--port", "0", "--set", "streams={}", "--data", str(tmp_path / "d"),
         "--set", f"paths.runtime={tmp_path / 'r'}"],
        cwd=ROOT, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "NOTIFY_SOCKET": address, "WATCHDOG_USEC": "200000"},
    )  # fmt: skip
    try:
        assert heard.recv(100).startswith(b"READY=1")
        assert [heard.recv(100) for _ in range(3)] == 3 * [b"WATCHDOG=1"]
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=300)
        assert process.returncode == 0 and re.search("IntraSplat is on", said)
        while not (last := heard.recv(100)).startswith(b"STOPPING=1"):
            assert last == b"WATCHDOG=1"
    finally:
        process.kill()
        process.communicate()
