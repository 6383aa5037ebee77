"""The streams of a server, without their processes: what is refused, what is kept."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path

import pytest

from services.api.parts import NewStream
from services.api.problems import Conflicting, Missing, Unprocessable
from services.bus.runtime import RuntimeFolder
from services.supervisor.stream import StreamDisplays, SupervisedStreams


@pytest.fixture
def streams():
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        yield SupervisedStreams(RuntimeFolder(Path(folder)), lambda event: None, most=3)


def stream(name="theatre-1", **options):
    return NewStream(name, "synthetic:?width=64", "live", "cpu", options)


def test_a_stream_is_stopped_until_it_is_started_and_gone_when_it_is_deleted(streams):
    async def run():
        made = await streams.create(stream(scale=0.5))
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
        assert list(await streams.all()) == []

    asyncio.run(run())


def test_what_cannot_be_is_refused_and_changes_nothing(streams):
    async def run():
        await streams.create(stream())
        with pytest.raises(Conflicting, match="a stream named theatre-1 already exists"):
            await streams.create(stream())
        with pytest.raises(Unprocessable, match="no option 'x'"):
            await streams.create(stream("theatre-2", x=1))
        with pytest.raises(Unprocessable, match="scale"):
            await streams.set_options("theatre-1", {"scale": -1})
        assert dict((await streams.get("theatre-1")).options) == {}
        for refused in (streams.get, streams.start, streams.stop, streams.delete):
            with pytest.raises(Missing):
                await refused("nobody")
        with pytest.raises(Conflicting, match="stopped"):
            await StreamDisplays(streams).subscribe("theatre-1", "raw", 80).__aenter__()
        for number in range(2):
            await streams.create(stream(f"more-{number}"))
        with pytest.raises(Conflicting, match=r"there are 3 streams, which is limits\.streams"):
            await streams.create(stream("too-many"))

    asyncio.run(run())
