"""Requests to the launcher and the ends that it remembers, without forking anything."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from services.bus.messages import packed_json
from services.bus.runtime import ProcessIdentity
from services.supervisor import launcher as launchers
from services.supervisor.launcher import MOST_REMEMBERED, Launcher
from services.supervisor.worker import Parent

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
