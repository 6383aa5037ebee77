"""Streams of a server with stand-ins for their processes."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest

from services.bus.runtime import RuntimeFolder
from services.errors import Conflict, NotFound, Rejected
from services.settings import StreamSettings
from services.supervisor import stream as stream_module
from services.supervisor.stream import SupervisedStreams


@pytest.fixture
def streams():
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        yield SupervisedStreams(RuntimeFolder(Path(folder)), lambda event: None, most=3)


def stream(**options):
    settings = StreamSettings(source="synthetic:?width=64", device="cpu")
    return settings.model_copy(update={"options": options})


def test_stream_is_created_stopped_changed_and_deleted(streams):
    async def run():
        made = streams.create("theatre-1", stream(scale=0.5))
        assert (made.name, made.state, made.device, dict(made.options)) == (
            "theatre-1",
            "stopped",
            "cpu",
            {"scale": 0.5},
        )
        changed = await streams.set_options("theatre-1", {"loop": False})
        assert dict(changed.options) == {"scale": 0.5, "loop": False}
        assert (await streams.stop("theatre-1")).state == "stopped"
        await streams.delete("theatre-1")
        assert list(streams.all()) == []

    asyncio.run(run())


def test_supervised_streams_refuse_invalid_requests_without_change(streams):
    async def run():
        streams.create("theatre-1", stream())
        with pytest.raises(Conflict, match="a stream named theatre-1 already exists"):
            streams.create("theatre-1", stream())
        with pytest.raises(Rejected, match="no option 'x'"):
            streams.create("theatre-2", stream(x=1))
        with pytest.raises(Rejected, match="scale"):
            await streams.set_options("theatre-1", {"scale": -1})
        assert dict(streams.get("theatre-1").options) == {}
        with pytest.raises(NotFound):
            streams.get("nobody")
        for refused in (streams.start, streams.stop, streams.delete):
            with pytest.raises(NotFound):
                await refused("nobody")
        with pytest.raises(Conflict, match="stopped"):
            await streams.subscribe("theatre-1", "raw", 80).__aenter__()
        for number in range(2):
            streams.create(f"more-{number}", stream())
        with pytest.raises(Conflict, match=r"there are 3 streams, which is limits\.streams"):
            streams.create("too-many", stream())

    asyncio.run(run())


class Process:
    """Stand-in for a supervised process."""

    made: ClassVar[list[Process]] = []

    def __init__(self, spec, folder, start, on_event):
        self.role, self.opened, self.closed = spec.role, 0, []
        self.state = SimpleNamespace(state="running", reason="")
        self.made.append(self)

    def open(self):
        self.opened += 1

    async def close(self, reason):
        self.closed.append(reason)


class Hub:
    def __init__(self, folder):
        self.folder, self.closed = folder, 0

    async def close(self):
        self.closed += 1


@pytest.fixture
def processes(monkeypatch, streams):
    monkeypatch.setattr(Process, "made", [])
    monkeypatch.setattr(stream_module, "ManagedProcess", Process)
    monkeypatch.setattr(stream_module, "DisplayHub", Hub)
    monkeypatch.setattr(streams._launcher, "open", lambda: Process.made.append("launcher"))
    return Process.made


def test_stream_starts_once_and_stop_removes_its_folder(streams, processes):
    async def run():
        streams.create("theatre-1", stream())
        assert processes == []
        await streams._stream("theatre-1").start()
        await streams._stream("theatre-1").start()
        assert sorted(process.role for process in processes) == ["capture", "engine"]
        assert [process.opened for process in processes] == [1, 1]
        assert streams.engine("theatre-1").role == "engine"
        processes[1].state.state = processes[0].state.state = "starting"
        with pytest.raises(Conflict, match="ask again when the stream is live"):
            streams.engine("theatre-1")
        made, hub = streams._stream("theatre-1"), streams._stream("theatre-1").hub
        folder = made.folder.path
        assert folder.exists()
        await made.stop("why")
        await made.stop("again")
        assert [process.closed for process in processes] == [["why"], ["why"]] and hub.closed == 1
        assert not folder.exists() and made.hub is None and made.processes == {}
        with pytest.raises(Conflict, match="stopped"):
            streams.engine("theatre-1")

    asyncio.run(run())


def test_launcher_opens_before_first_stream_starts(streams, processes, monkeypatch):
    monkeypatch.setattr(stream_module.Stream, "view", lambda self: self.name)

    async def run():
        streams.create("theatre-1", stream())
        assert await streams.start("theatre-1") == "theatre-1"
        assert processes[0] == "launcher" and len(processes) == 3

    asyncio.run(run())


class SlowProcess(Process):
    """Process whose close yields to other tasks."""

    async def close(self, reason):
        for _ in range(5):
            await asyncio.sleep(0)
        await super().close(reason)


@pytest.fixture
def slow(processes, monkeypatch):
    monkeypatch.setattr(stream_module, "ManagedProcess", SlowProcess)
    monkeypatch.setattr(stream_module.Stream, "view", lambda self: self.settings)
    return processes


@pytest.mark.parametrize("late", ["start", "set_options", "stop", "delete"])
def test_concurrent_calls_do_not_restart_deleted_stream(streams, slow, late):
    """Processes of a deleted stream would never be stopped."""

    async def run():
        streams.create("theatre-1", stream())
        await streams.start("theatre-1")
        arguments = [{"scale": 0.5}] if late == "set_options" else []
        results = await asyncio.gather(
            streams.delete("theatre-1"), getattr(streams, late)("theatre-1", *arguments), return_exceptions=True
        )
        assert results[0] is None and isinstance(results[1], NotFound)

    asyncio.run(run())
    started = [process for process in slow if process != "launcher"]
    assert len(started) == 2 and all(process.closed for process in started)


def test_concurrent_set_options_are_all_kept(streams, slow):
    async def run():
        streams.create("theatre-1", stream())
        await streams.start("theatre-1")
        await asyncio.gather(*(streams.set_options("theatre-1", {n: v}) for n, v in (("scale", 0.5), ("loop", False))))
        assert streams._stream("theatre-1").settings.options == {"scale": 0.5, "loop": False}

    asyncio.run(run())


def test_running_creates_streams_of_settings_and_obeys_start_option(streams, processes, monkeypatch):
    closed, removed = [], []

    async def close(*, stop):
        closed.append(stop)

    monkeypatch.setattr(stream_module, "remove_dead", lambda: removed.append(None))
    monkeypatch.setattr(stream_module.Stream, "view", lambda self: self.name)
    monkeypatch.setattr(streams._launcher, "close", close)

    async def run():
        at_start = {"one": stream(), "two": stream().model_copy(update={"start": False})}
        async with streams.running(at_start):
            assert [each.name for each in streams.streams()] == ["one", "two"]
            assert [each.hub is not None for each in streams.streams()] == [True, False]
            assert len(removed) == 1 and closed == []
        assert [process.closed for process in processes[1:]] == [["the server ends"]] * 2
        assert closed == [True] and len(removed) == 2

    asyncio.run(run())


def test_new_streams_alternate_between_gpus(streams, processes, monkeypatch):
    monkeypatch.setattr(stream_module, "gpus", lambda: 2)
    monkeypatch.setattr(stream_module.Stream, "view", lambda self: self.name)
    gpus = []
    for number in range(3):
        streams.create(f"theatre-{number}", stream().model_copy(update={"device": "cuda"}))
        gpus.append(streams._streams[f"theatre-{number}"].specs["engine"].engine.gpu)
    assert gpus == [0, 1, 0]
