"""The streams of a server, without their processes: what is refused, what is kept."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path

import pytest

from services.bus.runtime import RuntimeFolder
from services.errors import Conflict, NotFound, Rejected
from services.settings import StreamSettings
from services.supervisor.stream import SupervisedStreams


@pytest.fixture
def streams():
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        yield SupervisedStreams(RuntimeFolder(Path(folder)), lambda event: None, most=3)


def stream(**options):
    settings = StreamSettings(source="synthetic:?width=64", device="cpu")
    return settings.model_copy(update={"options": options})


def test_a_stream_is_stopped_until_it_is_started_and_gone_when_it_is_deleted(streams):
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


def test_what_cannot_be_is_refused_and_changes_nothing(streams):
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
