"""Complete streams on a small synthetic endoscope: processes are killed, stopped, orphaned and adopted."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch
import zmq

from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from services.bus.messages import picture_from, subscribe
from services.bus.runtime import ProcessIdentity, RuntimeFolder
from services.settings import StreamSettings
from services.supervisor.launcher import ByLauncher, Direct
from services.supervisor.process import ManagedProcess, StreamEvent
from services.supervisor.stream import Stream
from services.supervisor.worker import ProcessLimits, ProcessSpec, SourceSpec, specs_of

pytestmark = pytest.mark.slow

SMALL = "synthetic:?width=64&height=64&frames=3&fps=20"
SOON_S = 300.0


def spec(address: str = SMALL, **limits) -> ProcessSpec:
    return ProcessSpec(stream="a", capture=SourceSpec(address=address), limits=ProcessLimits(**limits))


async def wait_until(what) -> None:
    async with asyncio.timeout(SOON_S):
        while not what():
            await asyncio.sleep(0.02)


class Headers:
    """Headers of a socket's pictures, in order of receipt."""

    def __init__(self, endpoint: str) -> None:
        self.seen: list[dict] = []
        self._socket = subscribe(zmq.asyncio.Context.instance().socket(zmq.SUB), endpoint, waiting=64)
        self._task = asyncio.create_task(self._listen())

    async def _listen(self) -> None:
        while True:
            self.seen.append(dict(picture_from(await self._socket.recv_multipart(copy=False)).header))

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        self._socket.close()


def of_one_process(headers: list[dict]) -> bool:
    """Return true if several pictures came from one capture process, in order. A busy machine drops some of them."""
    numbers = [header["seq"] for header in headers]
    return len({header["run"] for header in headers}) == 1 and len(numbers) > 3 and numbers == sorted(set(numbers))


@contextlib.asynccontextmanager
async def capturing(runtime: RuntimeFolder, events: list[StreamEvent] | None = None, **limits):
    """Run a supervised capture process."""
    folder = runtime.stream("a")
    process = ManagedProcess(spec(**limits), folder, Direct(), [].append if events is None else events.append)
    process.open()
    try:
        yield process
    finally:
        await process.close("over")


def kill(pid: int | None, number: int = signal.SIGKILL) -> None:
    assert pid is not None
    os.kill(pid, number)


def test_killed_capture_is_restarted_with_reason(runtime):
    async def scenario() -> None:
        events: list[StreamEvent] = []
        async with capturing(runtime, events) as capture:
            headers = Headers(runtime.stream("a").pictures("capture"))
            await wait_until(lambda: capture.state.state == "live" and headers.seen)
            pid, run = capture.state.pid, headers.seen[-1]["run"]
            kill(pid)
            await wait_until(lambda: headers.seen[-1]["run"] != run)
            assert capture.state.pid != pid and capture.state.restarts == 1
            assert [event.kind for event in events] == ["started", "ended", "started"]
            assert "SIGKILL" in events[1].reason
            await headers.close()
        assert events[-1].kind == "stopped"
        assert not (runtime.path / "a" / "capture.json").exists()

    asyncio.run(scenario())


def test_hung_capture_is_replaced(runtime):
    async def scenario() -> None:
        events: list[StreamEvent] = []
        async with capturing(runtime, events, heartbeat_s=1.0) as capture:
            await wait_until(lambda: capture.state.state == "live")
            pid = capture.state.pid
            kill(pid, signal.SIGSTOP)
            await wait_until(lambda: capture.state.pid not in (pid, None) and capture.state.state == "live")
            assert "said nothing" in next(event.reason for event in events if event.kind == "ended")

    asyncio.run(scenario())


def test_capture_with_missing_file_fails_with_its_path(runtime):
    async def scenario() -> None:
        wrong = spec("/nowhere/to/be/found.mp4")
        process = ManagedProcess(wrong, runtime.stream("a"), Direct(), lambda event: None)
        process.open()
        await wait_until(lambda: process.state.state == "failed")
        assert "/nowhere/to/be/found.mp4" in process.state.reason
        await process.close("over")

    asyncio.run(scenario())


DYING = """
import os, subprocess, sys, time
from pathlib import Path
from services.bus.runtime import ProcessIdentity, RuntimeFolder
from services.supervisor.worker import ProcessSpec, SourceSpec

folder = RuntimeFolder(Path(sys.argv[1])).stream("a")
path = ProcessSpec(stream="a", capture=SourceSpec(address=sys.argv[2])).write(folder)
subprocess.Popen([sys.executable, "-m", "services.supervisor.capture", "--spec", path])
while (record := folder.record("capture")) is None:
    time.sleep(0.02)
print(record.identity.pid, flush=True)
time.sleep(600)
"""


def test_capture_ends_when_supervisor_is_killed(runtime):
    command = [sys.executable, "-c", DYING, str(runtime.path), SMALL]
    supervisor = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert supervisor.stdout is not None
    capture = ProcessIdentity.of(int(supervisor.stdout.readline()))
    supervisor.kill()
    supervisor.wait()
    supervisor.stdout.close()
    assert capture is not None and asyncio.run(capture.ended(SOON_S))
    assert sorted(file.name for file in (runtime.path / "a").iterdir()) == ["capture.lock", "capture.spec"]


def test_capture_does_not_import_torch(runtime):
    program = (
        "import sys, services.supervisor.capture, services.supervisor.capture, operators.sources.recording\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.fixture
def bundle(tmp_path):
    """A model of one Gaussian."""
    one = Gaussians(
        *(torch.tensor(values) for values in ([[0.0, 0, 4]], [[1.0, 0, 0, 0]], [[0.0, 0, 0]], [2.0], [[[1.0, 0, 0]]]))
    )
    save_bundle(Model(1, one, None, Camera.from_focal(30.0, 32, 24), (0.0, 1.0)), tmp_path / "bundle")
    return tmp_path / "bundle"


CONTROL_PLANE = """
import asyncio, sys
from pathlib import Path
from services.bus.runtime import RuntimeFolder
from services.supervisor.launcher import ByLauncher
from services.settings import StreamSettings
from services.supervisor.stream import Stream
from services.supervisor.worker import ProcessLimits, specs_of

async def run():
    runtime = RuntimeFolder(Path(sys.argv[1]))
    launcher = ByLauncher(runtime, orphan_after_s=600.0)
    launcher.open()
    await launcher.ready.wait()
    settings = StreamSettings(source=sys.argv[2], device="cpu", options={"engine_scale": 1})
    specs = specs_of("a", settings, ProcessLimits(orphan_after_s=600.0))
    await Stream(settings, specs, runtime, start=launcher).start()
    await asyncio.sleep(600)

assert "torch" not in sys.modules and "cv2" not in sys.modules
asyncio.run(run())
"""


def test_processes_survive_kills_of_control_plane_and_each_other(runtime, bundle):
    """One long scenario, because an engine takes seconds to start."""

    async def scenario() -> None:
        command = [sys.executable, "-c", CONTROL_PLANE, str(runtime.path), SMALL]
        control = subprocess.Popen(command)
        folder = runtime.stream("a")
        raw, shown = Headers(folder.pictures("capture")), Headers(folder.pictures("engine"))
        events: list[StreamEvent] = []
        launcher = ByLauncher(runtime, orphan_after_s=600.0)
        settings = StreamSettings(source=SMALL, device="cpu", options={"engine_scale": 1})
        specs = specs_of("a", settings, ProcessLimits(orphan_after_s=600.0))
        stream = Stream(settings, specs, runtime, start=launcher, on_event=events.append)
        try:
            await wait_until(lambda: len(shown.seen) > 3)

            # The control plane is killed: both processes go on, and the next one adopts them.
            before = {role: folder.record(role) for role in ("capture", "engine")}
            control.kill()
            control.wait()
            seen = len(shown.seen)
            await wait_until(lambda: len(shown.seen) > seen + 3)
            launcher.open()
            await stream.start()
            await wait_until(lambda: stream.engine.state.state == "running" and stream.capture.state.state == "live")
            assert {event.role: event.kind for event in events} == {"capture": "adopted", "engine": "adopted"}
            for role, record in before.items():
                assert record is not None and stream.processes[role].state.pid == record.identity.pid
            assert (await stream.engine.command("ping"))["pid"] == stream.engine.state.pid
            await wait_until(launcher.ready.is_set)

            # The engine is killed twice: raw pictures go on, and it comes back.
            raw.seen.clear()
            for _ in range(2):
                pid = stream.engine.state.pid
                kill(pid)
                at_ns = time.monotonic_ns()
                await wait_until(lambda at_ns=at_ns: shown.seen[-1]["arrived_ns"] > at_ns)
                assert stream.engine.state.pid != pid
            assert of_one_process(raw.seen)
            assert [event.kind for event in events if event.role == "engine"][1:] == ["ended", "started"] * 2
            assert "SIGKILL" in events[-2].reason

            # Capture is killed: the engine stays, and goes on with the next one. That one is killed as soon as it is there, and now the next one is
            # started only after a while: the engine says that the source is lost.
            pid, seen = stream.engine.state.pid, len(shown.seen)
            for _ in range(2):
                run = raw.seen[-1]["run"]
                kill(stream.capture.state.pid)
                await wait_until(lambda run=run: raw.seen[-1]["run"] != run)
            await wait_until(lambda: any(header["state"] == "source lost" for header in shown.seen[seen:]))
            await wait_until(lambda: shown.seen[-1]["state"] != "source lost")
            assert stream.engine.state.pid == pid
            numbers = [header["seq"] for header in shown.seen[seen:] if header["new"]]
            assert numbers == sorted(numbers)

            # A finished model takes over from the live reconstruction, outlasts the engine, and gives way again.
            answer = await stream.engine.command("show_model", timeout_s=SOON_S, folder=str(bundle), version=7)
            assert answer["version"] == 7
            await wait_until(lambda: shown.seen[-1]["show"] == "model")
            kill(stream.engine.state.pid)
            at_ns, seen = time.monotonic_ns(), len(shown.seen)
            await wait_until(lambda: shown.seen[-1]["arrived_ns"] > at_ns)
            assert {(each["show"], each["model_version"]) for each in shown.seen[seen:]} == {("model", 7)}
            await wait_until(lambda: stream.engine.state.state == "running")
            await stream.engine.command("show_live")
            await wait_until(lambda: shown.seen[-1]["show"] == "live")

            # Everything is ended: nothing is left.
            pids = [stream.engine.state.pid, stream.capture.state.pid]
            await stream.stop("the test is over")
            await launcher.close(stop=True)
            assert all(ProcessIdentity.of(pid) is None for pid in pids if pid is not None)
            assert [path.name for path in runtime.path.iterdir()] == ["launcher.log"]
            assert {event.reason for event in events if event.kind == "stopped"} == {"the test is over"}
        finally:
            control.kill()
            await stream.stop()
            await launcher.close(stop=True)
            await raw.close()
            await shown.close()

    asyncio.run(scenario())


@pytest.mark.parametrize("what", ["said", "log"])
def test_state_and_log_omit_password_of_source_address(runtime, what):
    secret = spec("rtsp://user:swordfish@127.0.0.1:1/stream")

    async def scenario() -> None:
        process = ManagedProcess(secret, runtime.stream("a"), Direct(), lambda event: None)
        process.open()
        await wait_until(lambda: process.state.state == "opening")
        said = json.dumps([process.state.reason, *map(str, process.state.figures.items())])
        log = runtime.stream("a").log("capture").read_text()
        await process.close("over")
        assert "swordfish" not in (said if what == "said" else log)

    asyncio.run(scenario())
