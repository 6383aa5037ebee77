"""Requests to the launcher and the ends that it remembers, without forking anything."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from services.bus.messages import packed_json
from services.bus.runtime import ProcessIdentity, RuntimeFolder
from services.supervisor import launcher as launchers
from services.supervisor.launcher import MOST_REMEMBERED, Launcher
from services.supervisor.worker import Parent
from tests.services.virtual_time import in_virtual_time

DEAD = ProcessIdentity(os.getpid(), "another boot 1")


@pytest.fixture
def launcher(tmp_path: Path) -> Iterator[Launcher]:
    launcher = Launcher(tmp_path / "socket", Parent(None, 0.0))
    yield launcher
    launcher._listener.close()


def asked(launcher: Launcher, request: bytes) -> dict[str, object]:
    ours, its = socket.socketpair()
    with ours, its:
        ours.sendall(request)
        return launcher._answer(its)


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ({"command": "ping"}, {"ok": True}),
        ({"command": "nonsense"}, {"ok": False}),
        ({}, {"ok": False}),
        ({"command": "status", "pid": 7}, {"ok": True, "status": "signal 9"}),
        ({"command": "status", "pid": 8}, {"ok": True, "status": None}),
    ],
)
def test_answers(launcher: Launcher, request_: dict[str, object], answer: dict[str, object], monkeypatch) -> None:
    monkeypatch.setattr(launcher, "_reap", lambda: launcher._ends.update({7: "signal 9"}))
    assert asked(launcher, packed_json(request_)) == answer
    assert not launcher._stopped


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        (b"junk", "BadMessage"),
        (packed_json({"command": "status"}), "KeyError"),
        (packed_json({"command": "status", "pid": "x"}), "ValueError"),
        (packed_json({"command": "start", "module": "os", "arguments": []}), "ValueError: 'os' is not forked"),
    ],
)
def test_a_wrong_request_is_refused_and_the_launcher_goes_on(launcher: Launcher, request_: bytes, error: str) -> None:
    answer = asked(launcher, request_)
    assert answer["ok"] is False and str(answer["error"]).startswith(error)
    assert not launcher._stopped


def test_a_ping_names_the_next_supervisor(launcher: Launcher) -> None:
    launcher._parent.identity = DEAD
    assert launcher._parent.lost(0.0)
    asked(launcher, packed_json({"command": "ping", "supervisor": asdict(ProcessIdentity.own())}))
    assert not launcher._parent.lost(1.0)


def test_it_ends_when_it_is_told_to_is_an_orphan_or_its_socket_is_gone(tmp_path: Path) -> None:
    stopped = Launcher(tmp_path / "stopped", Parent(None, 0.0))
    assert asked(stopped, packed_json({"command": "stop"})) == {"ok": True}
    orphan = Launcher(tmp_path / "orphan", Parent(DEAD, 0.0))
    gone = Launcher(tmp_path / "gone", Parent(None, 0.0))
    (tmp_path / "gone").unlink()
    for each in (stopped, orphan, gone):
        each.serve()  # returns
        assert each._listener.fileno() == -1
    assert list(tmp_path.iterdir()) == []


def test_the_newest_ends_are_remembered(launcher: Launcher, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = iter([*((number, 9) for number in range(1, MOST_REMEMBERED + 3)), (0, 0)])
    monkeypatch.setattr(launchers.os, "waitpid", lambda pid, flags: next(ended))
    launcher._reap()
    assert list(launcher._ends) == list(range(3, MOST_REMEMBERED + 3))
    assert launcher._ends[3] == launchers.ended_how(9)

    def no_child(pid: int, flags: int) -> tuple[int, int]:
        assert flags == os.WNOHANG
        raise ChildProcessError

    monkeypatch.setattr(launchers.os, "waitpid", no_child)
    launcher._reap()
    assert len(launcher._ends) == MOST_REMEMBERED


def test_an_old_socket_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "socket").write_text("left by another")
    launcher = Launcher(tmp_path / "socket", Parent(None, 0.0))
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(tmp_path / "socket"))
        launcher.stop()
    launcher.serve()


class Started:
    """Start of processes that records modules and times, and answers with numbers from 100."""

    def __init__(self) -> None:
        self.modules: list[tuple[str, float]] = []

    async def start(self, module, arguments, output, environment, *, fresh=False) -> int:
        self.modules.append((module, round(asyncio.get_running_loop().time(), 2)))
        return 99 + len(self.modules)


@pytest.mark.parametrize(
    ("ready_s", "engine_s", "forked"), [(59.0, 59.0, True), (61.0, 60.0, False), (None, 60.0, False)]
)
def test_an_engine_waits_a_minute_for_a_launcher_that_is_loading(tmp_path, monkeypatch, ready_s, engine_s, forked):
    by = launchers.ByLauncher(RuntimeFolder(tmp_path))
    by._direct = direct = Started()
    asked = []

    async def ask(command, **arguments):
        asked.append((command, arguments["module"], round(asyncio.get_running_loop().time(), 2)))
        return {"pid": 7}

    monkeypatch.setattr(by, "_ask", ask)

    async def start() -> None:
        by._keeping = asyncio.ensure_future(asyncio.sleep(1000))
        if ready_s is not None:
            asyncio.get_running_loop().call_later(ready_s, by.ready.set)
        pid = await by.start("services.supervisor.capture", [], tmp_path / "log", {})
        assert pid == 100 and direct.modules == [("services.supervisor.capture", 0.0)]
        pid = await by.start("services.supervisor.engine", [], tmp_path / "log", {})
        assert pid == (7 if forked else 101)
        by._keeping.cancel()

    in_virtual_time(start())
    engine = ("services.supervisor.engine", engine_s)
    assert (asked, direct.modules[1:]) == (([("start", *engine)], []) if forked else ([], [engine]))


def test_a_launcher_is_asked_every_second_and_started_again_when_it_has_ended(tmp_path, monkeypatch):
    by = launchers.ByLauncher(RuntimeFolder(tmp_path))
    by._direct = direct = Started()
    times, there, alive = [], [], {}
    now = lambda: asyncio.get_running_loop().time()

    async def ask(command, **arguments):
        times.append(round(now(), 2))
        if 2.5 < now() < 3.5:
            raise launchers.NoAnswer("busy")
        return {}

    # The first launcher has loaded after half a second and ends after 6 s.
    monkeypatch.setattr(by, "_ask", ask)
    monkeypatch.setattr(launchers, "recorded_launcher", lambda folder: "one" if 0.5 <= now() < 6 else None)
    monkeypatch.setattr(launchers, "status_of_child", lambda pid: "signal 9" if pid == 100 and now() > 6 else None)
    monkeypatch.setattr(launchers, "_runs", lambda pid: alive.setdefault(pid, True))

    async def watch() -> None:
        by.open()
        by.open()
        for _ in range(7):
            await asyncio.sleep(1.0)
            there.append(by.ready.is_set())
        await by.close(stop=False)

    in_virtual_time(watch())
    assert direct.modules[0] == ("services.supervisor.launcher", 0.0) and len(direct.modules) == 2
    assert 6 <= direct.modules[1][1] < 7
    assert 0.5 <= times[0] < 0.6
    assert np.diff(times).round(2).tolist() == [1.0] * (len(times) - 1)
    assert there == [True, True, False, True, True, True, False]


@pytest.mark.parametrize(("argument", "code"), [("7", 7), ("wrong", 1)])
def test_a_forked_process_has_its_environment_log_and_session_and_ends_with_the_code_of_its_module(
    tmp_path, monkeypatch, argument, code
):
    module = ModuleType("forked_by_a_test")

    def main(arguments):
        os.write(1, f"{os.environ['INTRASPLAT_FORKED']} {arguments} {os.getsid(0) == os.getpid()}\n".encode())
        os.write(2, b"error\n")
        return int(arguments[0])

    module.main = main  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(signal, "signal", lambda number, handler: os.write(log, f"{number} {handler!r}\n".encode()))
    log = os.open(tmp_path / "log", os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o600)
    pid = os.fork()
    if pid == 0:
        launchers._become(module.__name__, [argument], {"INTRASPLAT_FORKED": "yes"}, log)
    os.close(log)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == code
    lines = (tmp_path / "log").read_text().splitlines()
    assert sorted(int(line.split()[0]) for line in lines[:3]) == sorted((signal.SIGTERM, signal.SIGINT, signal.SIGHUP))
    assert lines[3:5] == [f"yes ['{argument}'] True", "error"]
    assert "INTRASPLAT_FORKED" not in os.environ
