"""NVIDIA's Multi-Process Service for engines, with a stand-in for its control program."""

from __future__ import annotations

import asyncio
import os
import tempfile
from pathlib import Path

import pytest

from services.bus.runtime import RuntimeFolder
from services.errors import CannotServe, RuntimeFolderUnusable
from services.settings import StreamSettings
from services.supervisor import gpu_sharing
from services.supervisor.gpu_sharing import CONTROL, WithMps, check_mps, end_mps
from services.supervisor.stream import SupervisedStreams

DAEMON = """#!/bin/sh
# As NVIDIA's program: -d leaves a daemon, which keeps the output open; without options, commands are read from the standard input.
cd "$CUDA_MPS_PIPE_DIRECTORY"
if [ "$1" = -d ]; then
  if [ -e running ]; then echo "An instance of this daemon is already running"; exit 1; fi
  echo "started$CUDA_VISIBLE_DEVICES" >> calls; touch running; sleep 20 &
  echo $! > pid
  exit 0
fi
while read -r line; do echo "$line" >> calls; done
kill "$(cat pid)"; rm running
"""


@pytest.fixture
def runtime():
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        yield RuntimeFolder(Path(folder))


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Return a function that installs a shell script as the control program."""
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    def install(text: str) -> None:
        path = tmp_path / CONTROL
        path.write_text(text)
        path.chmod(0o755)

    return install


class Started:
    """Stand-in for the launcher, which keeps what was to be started."""

    def __init__(self):
        self.calls = []

    async def start(self, module, arguments, output, environment, *, fresh=False):
        self.calls.append((module, list(arguments), environment, fresh))
        return 4711

    async def how_ended(self, pid):
        return f"{pid} ended"


def start(with_mps: WithMps, role: str = "engine") -> int:
    given = f"services.supervisor.{role}", ["--spec", "x"], Path("log"), {"CUDA_VISIBLE_DEVICES": "1"}
    return asyncio.run(with_mps.start(*given, fresh=True))


def calls(runtime: RuntimeFolder) -> list[str]:
    return (runtime.path / ".mps" / "calls").read_text().split()


def test_engines_share_one_daemon_that_ends_with_the_service(runtime, program, monkeypatch):
    program(DAEMON)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")  # which the daemon must not have
    inner = Started()
    with_mps = WithMps(inner, runtime)
    assert start(with_mps) == start(with_mps) == 4711
    folder = os.fspath(runtime.path / ".mps")
    shared = {"CUDA_VISIBLE_DEVICES": "1", "CUDA_MPS_PIPE_DIRECTORY": folder, "CUDA_MPS_LOG_DIRECTORY": folder}
    assert inner.calls == 2 * [("services.supervisor.engine", ["--spec", "x"], shared, True)]
    assert (runtime.path / ".mps").stat().st_mode & 0o077 == 0
    assert calls(runtime) == ["started"]
    asyncio.run(end_mps(runtime))
    assert calls(runtime) == ["started", "quit"] and not (runtime.path / ".mps" / "running").exists()
    assert asyncio.run(with_mps.how_ended(5)) == "5 ended"


def test_capture_is_no_client_and_starts_no_daemon(runtime, program):
    program(DAEMON)
    inner = Started()
    with_mps = WithMps(inner, runtime)
    start(with_mps, "capture")
    assert inner.calls[0][2] == {"CUDA_VISIBLE_DEVICES": "1"}
    asyncio.run(end_mps(runtime))
    assert list((runtime.path / ".mps").iterdir()) == []


def test_next_service_uses_daemon_of_one_that_died(runtime, program):
    program(DAEMON)
    start(WithMps(Started(), runtime))
    after = WithMps(Started(), runtime)
    start(after)
    asyncio.run(end_mps(runtime))
    assert calls(runtime) == ["started", "quit"]


def test_ended_daemon_is_started_again_for_the_next_engine(runtime, program):
    program(DAEMON)
    with_mps = WithMps(Started(), runtime)
    start(with_mps)
    asyncio.run(end_mps(runtime))
    start(with_mps)
    asyncio.run(end_mps(runtime))
    assert calls(runtime) == ["started", "quit", "started", "quit"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("#!/bin/sh\necho 'MPS is not supported on this GPU'\nexit 3\n", "MPS is not supported on this GPU"),
        ("#!/bin/sh\nexit 3\n", "exit code 3"),
        ("#!/bin/sh\nexec sleep 60\n", "did not end within 0.3 s"),
        ("#!/missing/shell\n", f"{CONTROL}: No such file or directory"),
    ],
)
def test_engine_does_not_start_without_its_daemon(runtime, program, monkeypatch, text, reason):
    monkeypatch.setattr(gpu_sharing, "ANSWER_S", 0.3)
    program(text)
    inner = Started()
    with pytest.raises(OSError, match=r"Multi-Process Service \(gpu\.mps\) does not start: .*" + reason):
        start(WithMps(inner, runtime))
    assert inner.calls == []


def test_too_long_runtime_folder_is_refused():
    with tempfile.TemporaryDirectory(prefix="isp-" + 80 * "x") as folder, pytest.raises(RuntimeFolderUnusable):
        WithMps(Started(), RuntimeFolder(Path(folder)))


def test_check_names_the_missing_program(tmp_path, monkeypatch, program):
    monkeypatch.setenv("PATH", os.fspath(tmp_path))
    with pytest.raises(
        CannotServe, match=r"gpu\.mps is set, but there is no program nvidia-cuda-mps-control.*gpu\.mps: false"
    ):
        check_mps()
    program(DAEMON)
    check_mps()


class Launcher(Started):
    """Stand-in for the launcher process, whose end tells which other programs have ended before."""

    def __init__(self, folder, orphan_after_s):
        super().__init__()
        self.folder = folder

    def open(self):
        pass

    async def close(self, *, stop):
        with (self.folder.path / ".mps" / "calls").open("a") as file:
            file.write("launcher\n")


@pytest.mark.parametrize("mps", [False, True])
def test_streams_end_the_daemon_last_also_one_that_a_dead_service_left(runtime, program, monkeypatch, caplog, mps):
    monkeypatch.setattr("services.supervisor.stream.ByLauncher", Launcher)
    program(DAEMON)
    start(WithMps(Started(), runtime))

    async def run():
        async with SupervisedStreams(runtime, lambda event: None, mps=mps).running({}):
            pass

    asyncio.run(run())
    assert calls(runtime) == ["started", "launcher", "quit"]
    asyncio.run(run())
    assert calls(runtime) == ["started", "launcher", "quit", "launcher"] and not caplog.records


def test_daemon_that_does_not_end_is_logged(runtime, program, monkeypatch, caplog):
    program(DAEMON)
    start(WithMps(Started(), runtime))
    program("#!/bin/sh\necho 'Cannot find MPS control daemon process'\nexit 1\n")
    asyncio.run(end_mps(runtime))
    assert "does not end: Cannot find MPS control daemon process" in caplog.text


@pytest.mark.parametrize("mps", [False, True])
def test_only_engines_on_a_gpu_are_clients(runtime, program, monkeypatch, mps):
    program(DAEMON)
    launchers = []

    class Kept(Launcher):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            launchers.append(self)

        async def close(self, *, stop):
            pass

    monkeypatch.setattr("services.supervisor.stream.ByLauncher", Kept)
    monkeypatch.setattr("services.supervisor.stream.gpus", lambda: 1)

    async def run():
        streams = SupervisedStreams(runtime, lambda event: None, mps=mps)
        two = {name: StreamSettings(source="synthetic:?width=64", device=name) for name in ("cuda", "cpu")}
        async with streams.running(two), asyncio.timeout(20):
            while len({(call[0], call[1][1]) for call in launchers[0].calls}) < 4:
                await asyncio.sleep(0.01)

    asyncio.run(run())
    clients = {call[1][1] for call in launchers[0].calls if "CUDA_MPS_PIPE_DIRECTORY" in call[2]}
    assert clients == ({str(runtime.stream("cuda").spec("engine"))} if mps else set())


def test_engine_that_was_started_with_another_setting_is_replaced(runtime, monkeypatch):
    monkeypatch.setattr("services.supervisor.stream.gpus", lambda: 1)
    digests = {}
    for mps in (False, True):
        streams = SupervisedStreams(runtime, lambda event: None, mps=mps)
        for name in ("cuda", "cpu"):
            streams.create(name, StreamSettings(source="synthetic:?width=64", device=name))
        digests[mps] = {each.name: each.specs["engine"].digest for each in streams.streams()}
    assert digests[True]["cuda"] != digests[False]["cuda"] and digests[True]["cpu"] == digests[False]["cpu"]


def test_reason_why_daemon_does_not_start_is_the_engines_reason(runtime, program, monkeypatch):
    program("#!/bin/sh\necho 'MPS is not supported on this GPU'\nexit 3\n")
    monkeypatch.setattr("services.supervisor.stream.ByLauncher", Launcher)
    monkeypatch.setattr("services.supervisor.stream.gpus", lambda: 1)
    events = []

    async def run():
        streams = SupervisedStreams(runtime, events.append, mps=True)
        settings = StreamSettings(source="synthetic:?width=64", device="cuda")
        async with streams.running({"theatre": settings}), asyncio.timeout(20):
            while not [each for each in events if each.role == "engine" and each.kind == "ended"]:
                await asyncio.sleep(0.01)

    asyncio.run(run())
    (first, *_) = [each.reason for each in events if each.role == "engine" and each.kind == "ended"]
    assert first.startswith("it cannot be started: ") and "MPS is not supported on this GPU" in first


@pytest.mark.parametrize("mps", [False, True])
def test_streams_that_take_turns_on_a_gpu_are_logged(runtime, monkeypatch, caplog, mps):
    monkeypatch.setattr("services.supervisor.stream.gpus", lambda: 2)
    streams = SupervisedStreams(runtime, lambda event: None, mps=mps)
    for name, device in [("a", "cuda"), ("b", "cuda"), ("c", "cpu"), ("d", "cuda:1")]:
        streams.create(name, StreamSettings(source="synthetic:?width=64", device=device))
    turns = [record.getMessage() for record in caplog.records if "take turns" in record.getMessage()]
    assert len(turns) == (0 if mps else 1)
    assert all(line.startswith("d and other streams take turns on GPU 1; gpu.mps: true") for line in turns)
