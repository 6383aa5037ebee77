"""Requests to the launcher and remembered exit statuses, without forking."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import ModuleType, SimpleNamespace

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
def test_launcher_answers_known_requests(
    launcher: Launcher, request_: dict[str, object], answer: dict[str, object], monkeypatch
) -> None:
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
def test_launcher_refuses_malformed_request_without_stopping(launcher: Launcher, request_: bytes, error: str) -> None:
    answer = asked(launcher, request_)
    assert answer["ok"] is False and str(answer["error"]).startswith(error)
    assert not launcher._stopped


def test_ping_sets_supervisor_of_launcher(launcher: Launcher) -> None:
    launcher._parent.identity = DEAD
    assert launcher._parent.lost(0.0)
    asked(launcher, packed_json({"command": "ping", "supervisor": asdict(ProcessIdentity.own())}))
    assert not launcher._parent.lost(1.0)


def test_launcher_serve_ends_on_stop_orphan_or_removed_socket(tmp_path: Path) -> None:
    stopped = Launcher(tmp_path / "stopped", Parent(None, 0.0))
    assert asked(stopped, packed_json({"command": "stop"})) == {"ok": True}
    orphan = Launcher(tmp_path / "orphan", Parent(DEAD, 0.0))
    gone = Launcher(tmp_path / "gone", Parent(None, 0.0))
    (tmp_path / "gone").unlink()
    for each in (stopped, orphan, gone):
        each.serve()  # returns
        assert each._listener.fileno() == -1
    assert list(tmp_path.iterdir()) == []


def test_launcher_remembers_newest_exit_statuses(launcher: Launcher, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_launcher_replaces_old_socket_file(tmp_path: Path) -> None:
    (tmp_path / "socket").write_text("left by another")
    launcher = Launcher(tmp_path / "socket", Parent(None, 0.0))
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(tmp_path / "socket"))
        launcher.stop()
    launcher.serve()


class Started:
    """Process starter that records modules and times and returns process ids from 100."""

    def __init__(self) -> None:
        self.modules: list[tuple[str, float]] = []

    async def start(self, module, arguments, output, environment, *, fresh=False) -> int:
        self.modules.append((module, round(asyncio.get_running_loop().time(), 2)))
        return 99 + len(self.modules)


@pytest.mark.parametrize(
    ("ready_s", "engine_s", "forked"), [(59.0, 59.0, True), (61.0, 60.0, False), (None, 60.0, False)]
)
def test_engine_start_waits_up_to_60_s_for_loading_launcher(tmp_path, monkeypatch, ready_s, engine_s, forked):
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


def test_by_launcher_pings_every_second_and_restarts_ended_launcher(tmp_path, monkeypatch):
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


def test_by_launcher_creates_removed_runtime_folder_and_does_not_wait_for_what_cannot_start(
    tmp_path, monkeypatch, caplog
):
    folder = tmp_path / "runtime"
    by = launchers.ByLauncher(RuntimeFolder(folder))
    by._direct = direct = Started()
    monkeypatch.setattr(launchers, "status_of_child", lambda pid: None)
    monkeypatch.setattr(launchers, "_runs", lambda pid: True)

    async def watch() -> None:
        folder.rmdir()
        folder.touch()  # a file in place of the folder
        by.open()
        await asyncio.sleep(2.5)
        pid = await by.start("services.supervisor.engine", [], tmp_path / "log", {})
        assert (pid, direct.modules) == (100, [("services.supervisor.engine", 2.5)])
        folder.unlink()
        await asyncio.sleep(1.0)
        await by.close(stop=False)

    in_virtual_time(watch())
    assert direct.modules[1:] == [("services.supervisor.launcher", 3.0)]
    assert folder.stat().st_mode & 0o777 == 0o700
    assert [record.getMessage() for record in caplog.records] == [
        f"the launcher cannot be started: [Errno 20] Not a directory: '{folder / launchers.RECORD}'; processes are started directly"
    ]


@pytest.mark.parametrize(("argument", "code"), [("7", 7), ("wrong", 1)])
def test_forked_process_has_environment_log_session_and_exit_code(tmp_path, monkeypatch, argument, code):
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


def test_process_that_is_ended_right_after_its_fork_does_not_miss_the_signal(launcher, tmp_path, monkeypatch):
    module = ModuleType("forked_by_a_test")
    module.main = lambda arguments: time.sleep(2.0) or 0  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(launchers, "FORKED", (module.__name__,))
    request = {"module": module.__name__, "arguments": [], "environment": {}, "log": str(tmp_path / "log")}
    before = signal.signal(signal.SIGTERM, launcher.stop)
    try:
        for _ in range(10):
            ours, its = socket.socketpair()
            with ours, its:
                pid = launcher._start(request, its)
            os.kill(pid, signal.SIGTERM)
            assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGTERM
    finally:
        signal.signal(signal.SIGTERM, before)
    assert not launcher._stopped and signal.SIGTERM not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


class Ended:
    """Identity of a process that ends by some signals."""

    def __init__(self, *deadly: int) -> None:
        self.deadly, self.signals = deadly, []

    def signal(self, number: int) -> None:
        self.signals.append(number)

    async def ended(self, within_s: float | None = None) -> bool:
        return bool(set(self.signals) & set(self.deadly))


@pytest.mark.parametrize(
    ("stop", "deadly", "signals"),
    [(True, (signal.SIGTERM,), [signal.SIGTERM]), (True, (), [signal.SIGTERM, signal.SIGKILL]), (False, (), [])],
)
def test_by_launcher_close_ends_launcher_only_with_stop(tmp_path, monkeypatch, stop, deadly, signals):
    by, identity, waited = launchers.ByLauncher(RuntimeFolder(tmp_path)), Ended(*deadly), []
    monkeypatch.setattr(launchers, "recorded_launcher", lambda folder: identity)
    monkeypatch.setattr(launchers, "status_of_child", waited.append)
    by._own_pid = 100
    by.ready.set()
    for name in (launchers.SOCKET, launchers.RECORD):
        (by._folder.path / name).write_text("left")
    asyncio.run(by.close(stop=stop))
    assert identity.signals == signals and waited == [100] and not by.ready.is_set()
    assert (by._folder.path / launchers.SOCKET).exists() == (by._folder.path / launchers.RECORD).exists() == (not stop)


def test_by_launcher_close_ends_loading_launcher_by_pid(tmp_path, monkeypatch):
    by, identity = launchers.ByLauncher(RuntimeFolder(tmp_path)), Ended(signal.SIGTERM)
    monkeypatch.setattr(launchers, "recorded_launcher", lambda folder: None)
    monkeypatch.setattr(launchers, "status_of_child", lambda pid: None)
    monkeypatch.setattr(launchers.ProcessIdentity, "of", staticmethod(lambda pid: identity if pid == 100 else None))
    asyncio.run(by.close(stop=True))
    assert identity.signals == []
    by._own_pid = 100
    asyncio.run(by.close(stop=True))
    assert identity.signals == [signal.SIGTERM]


@pytest.mark.parametrize(
    ("answer", "error"),
    [(b'{"ok": true, "pid": 7}', None), (b'{"ok": false, "error": "no memory"}', "refuses 'start': no memory"), (b"{}", "refuses"), (None, "has not answered 'start' within")],
)  # fmt: skip
def test_by_launcher_raises_no_answer_for_refusal_or_timeout(tmp_path, monkeypatch, answer, error):
    by = launchers.ByLauncher(RuntimeFolder(tmp_path))
    requests = []

    async def ask():
        closed = asyncio.Event()

        async def serve(reader, writer):
            requests.append(await reader.read(1000))
            if answer is None:
                await reader.read()  # until the client gives up
            else:
                writer.write(answer)
            writer.close()
            await writer.wait_closed()
            closed.set()

        server = await asyncio.start_unix_server(serve, os.fspath(by._folder.path / launchers.SOCKET))
        try:
            return await by._ask("start", module="m")
        finally:
            await closed.wait()
            server.close()

    if answer is None:
        monkeypatch.setattr(launchers, "ANSWER_S", 0.05)
    if error is None:
        assert asyncio.run(ask())["pid"] == 7
    else:
        with pytest.raises(launchers.NoAnswer, match=error):
            asyncio.run(ask())
    assert requests == [packed_json({"command": "start", "module": "m"})]


@pytest.mark.parametrize("fails", [False, True])
def test_by_launcher_starts_process_directly_if_launcher_fails(tmp_path, monkeypatch, fails):
    by, asked = launchers.ByLauncher(RuntimeFolder(tmp_path)), []
    by._direct = direct = Started()
    by.ready.set()

    async def ask(command, **arguments):
        asked.append((command, arguments))
        if fails:
            raise launchers.NoAnswer("busy")
        return {"pid": "7"}

    monkeypatch.setattr(by, "_ask", ask)
    engine = "services.supervisor.engine"
    pid = asyncio.run(by.start(engine, ["--a"], tmp_path / "log", {"b": "c"}))
    assert pid == (100 if fails else 7) and len(direct.modules) == fails
    expected = {"module": engine, "arguments": ["--a"], "log": str(tmp_path / "log"), "environment": {"b": "c"}}
    assert asked == [("start", expected)]
    assert asyncio.run(by.start(engine, [], tmp_path / "log", {}, fresh=True)) == 100 + fails
    assert asyncio.run(by.start("another.module", [], tmp_path / "log", {})) == 101 + fails
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("is_ready", "answer", "how"),
    [(True, {"status": "signal 9"}, "signal 9"), (True, {}, None), (True, None, None), (False, {"status": "no"}, None)],
)
def test_how_ended_asks_launcher_for_exit_status(tmp_path, monkeypatch, is_ready, answer, how):
    by = launchers.ByLauncher(RuntimeFolder(tmp_path))

    async def ask(command, **arguments):
        assert (command, arguments) == ("status", {"pid": 7})
        if answer is None:
            raise OSError("gone")
        return answer

    monkeypatch.setattr(by, "_ask", ask)
    monkeypatch.setattr(launchers, "status_of_child", lambda pid: "exit code 3" if pid == 8 else None)
    if is_ready:
        by.ready.set()
    assert asyncio.run(by.how_ended(7)) == how
    assert asyncio.run(by.how_ended(8)) == "exit code 3"


def test_launcher_start_forks_and_closes_unused_descriptors(launcher, tmp_path, monkeypatch):
    request = {"module": "services.supervisor.engine", "arguments": ["--a", 5], "environment": {"B": 6}, "log": str(tmp_path / "log")}  # fmt: skip
    monkeypatch.setattr(os, "fork", lambda: 77)
    answer = asked(launcher, packed_json({"command": "start", **request}))
    assert answer == {"ok": True, "pid": 77} and launcher._children == {77}
    assert (tmp_path / "log").stat().st_mode & 0o777 == 0o600
    assert not any(os.path.realpath(f"/proc/self/fd/{each}") == str(tmp_path / "log") for each in os.listdir("/proc/self/fd"))  # fmt: skip
    became = []

    class Became(Exception):
        pass

    def become(*given):
        became.append((*given[:3], launcher._listener.fileno(), os.fstat(given[3]).st_ino))
        raise Became

    monkeypatch.setattr(os, "fork", lambda: 0)
    monkeypatch.setattr(launchers, "_become", become)
    ours, its = socket.socketpair()
    with ours, its, pytest.raises(Became):
        launcher._start(request, its)
    log = (tmp_path / "log").stat().st_ino
    assert became == [("services.supervisor.engine", ["--a", "5"], {"B": "6"}, -1, log)] and its.fileno() == -1
    assert launcher._children == {77}


@pytest.mark.parametrize("hangs", [False, True])
def test_launcher_kills_children_that_do_not_end(launcher, monkeypatch, hangs):
    now, killed = SimpleNamespace(s=100.0), []

    def sleep(seconds):
        now.s += seconds

    def reap():
        if not hangs and now.s > 100.5:
            launcher._children.clear()

    monkeypatch.setattr(launchers, "time", SimpleNamespace(monotonic=lambda: now.s, sleep=sleep))
    monkeypatch.setattr(launcher, "_reap", reap)
    monkeypatch.setattr(os, "kill", lambda *given: killed.append(given))
    launcher._children.update({77})
    launcher._end_children()
    assert killed == ([(77, signal.SIGKILL)] if hangs else [])
    assert 100.5 < now.s < 102 if not hangs else 101 < now.s < 103


def test_launcher_program_records_itself_while_serving(tmp_path, monkeypatch):
    folder, handlers, made = RuntimeFolder(tmp_path), {}, []

    class Served:
        def __init__(self, path, parent):
            made.append((path, parent.identity))

        def stop(self, *_):
            pass

        def serve(self):
            assert (folder.path / launchers.RECORD).exists()
            raise RuntimeError("ended")

    monkeypatch.setattr(launchers, "Launcher", Served)
    monkeypatch.setattr(launchers, "FORKED", ())
    monkeypatch.setattr(launchers, "LOADED", ())
    monkeypatch.setattr(launchers.gc, "freeze", lambda: None)
    monkeypatch.setattr(launchers, "keep_files_private", lambda: None)
    monkeypatch.setattr(launchers.logging, "basicConfig", lambda **_: None)
    monkeypatch.setattr(signal, "signal", lambda number, handler: handlers.update({number: handler}))
    monkeypatch.setenv("PYTORCH_NVML_BASED_CUDA_CHECK", "0")
    own = ProcessIdentity.own()
    arguments = ["--folder", str(tmp_path), "--orphan-after-s", "2", "--supervisor", packed_json(asdict(own)).decode()]
    with pytest.raises(RuntimeError, match="ended"):
        launchers.main(arguments)
    assert made == [(folder.path / launchers.SOCKET, own)]
    assert set(handlers) == {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}
    assert not (folder.path / launchers.RECORD).exists(), "the record is removed although serving failed"
    assert os.environ["PYTORCH_NVML_BASED_CUDA_CHECK"] == "1"
    monkeypatch.setattr(launchers, "recorded_launcher", lambda _: own)
    assert launchers.main(arguments) == 2 and len(made) == 1
