from __future__ import annotations

import asyncio
import contextlib
import time

import numpy as np
import pytest
import simplejpeg

from gsplat_core.errors import InvalidSetting
from services import display as hubs
from services.bus.messages import PicturePublisher
from services.display import SLOW, DisplayHub

IMAGE = np.full((16, 24, 3), (200, 100, 50), np.uint8)
HEADER = {"state": "live", "new": True, "model_version": 3, "run": 1}


@contextlib.asynccontextmanager
async def published(runtime, every_s: float = 0.01):
    """Run a process stand-in that publishes pictures. Yield the hub and the publishing task."""
    folder = runtime.stream("a")
    publisher = PicturePublisher(folder.pictures("engine"))
    hub = DisplayHub(folder)

    async def publish() -> None:
        for seq in range(100_000):
            publisher.publish({**HEADER, "seq": seq, "arrived_ns": time.monotonic_ns()}, IMAGE)
            await asyncio.sleep(every_s)

    publishing = asyncio.create_task(publish())
    try:
        yield hub, publishing
    finally:
        publishing.cancel()
        await asyncio.gather(publishing, return_exceptions=True)
        await hub.close()
        publisher.close()


def run(scenario) -> None:
    async def within() -> None:
        async with asyncio.timeout(300):
            await scenario()

    asyncio.run(within())


def test_hub_encodes_picture_once_for_all_viewers(runtime):
    async def scenario() -> None:
        async with published(runtime) as (hub, _), hub.subscribe("shown") as one, hub.subscribe("shown") as other:
            seen = [(await anext(one), await anext(other))]
            while not any(a.jpeg is b.jpeg for a, b in seen):
                seen.append((await anext(one), await anext(other)))
            header = seen[-1][0].header
            assert header["state"] == "live" and header["model_version"] == 3
            assert (header["width_px"], header["height_px"], header["picture"]) == (24, 16, "shown")
            assert "run" not in header and "pixels" not in header
            assert np.abs(simplejpeg.decode_jpeg(seen[-1][0].jpeg).astype(int) - IMAGE).mean() < 5
            # Once for all viewers: as many as pictures, not twice as many.
            assert hub.counts("shown")["encoded"] <= seen[-1][0].header["seq"] + 2

    run(scenario)


def test_hub_encodes_each_requested_quality(runtime):
    async def scenario() -> None:
        async with (
            published(runtime) as (hub, _),
            hub.subscribe("shown", 20) as low,
            hub.subscribe("shown", 90) as high,
        ):
            assert len((await anext(low)).jpeg) < len((await anext(high)).jpeg)

    run(scenario)


def test_hub_encodes_nothing_without_viewers(runtime):
    async def scenario() -> None:
        async with published(runtime) as (hub, _):
            async with hub.subscribe("shown") as viewer:
                await anext(viewer)
            assert hub.viewers("shown") == 0
            before = hub.counts("shown")["encoded"]
            await asyncio.sleep(0.2)
            assert hub.counts("shown")["encoded"] <= before + 1  # one may have been under way
            async with hub.subscribe("shown") as viewer:
                await anext(viewer)

    run(scenario)


def test_slow_viewer_misses_pictures_and_other_viewer_does_not(runtime):
    async def scenario() -> None:
        async with published(runtime) as (hub, _), hub.subscribe("shown") as slow, hub.subscribe("shown") as quick:
            last = -1
            for _ in range(30):
                seq = (await anext(quick)).header["seq"]
                assert isinstance(seq, int) and seq > last
                last = seq
            assert hub.counts("shown")[SLOW] > 10
            newest = (await anext(slow)).header["seq"]
            assert isinstance(newest, int) and newest >= last - 1  # the newest, not the oldest

    run(scenario)


def test_hub_drops_dead_viewer(runtime, monkeypatch):
    monkeypatch.setattr("services.display.DEAD_S", 0.1)

    async def scenario() -> None:
        async with published(runtime) as (hub, _):
            dead = hub.subscribe("shown")
            while hub.viewers("shown"):
                await asyncio.sleep(0.01)
            assert hub.counts("shown")["dead client"] == 1
            with pytest.raises(StopAsyncIteration):
                await anext(dead)

    run(scenario)


def test_hub_repeats_last_picture_as_frozen_if_process_died(runtime, monkeypatch):
    monkeypatch.setattr(hubs, "REPEAT_S", 0.05)

    async def scenario() -> None:
        async with published(runtime) as (hub, publishing), hub.subscribe("shown") as viewer:
            await anext(viewer)
            publishing.cancel()
            states = []
            while "frozen" not in states:
                picture = await anext(viewer)
                states.append(picture.header["state"])
            assert picture.header["new"] is False
            assert isinstance(picture.header["age_ms"], float) and picture.header["age_ms"] > 400
            pixels = simplejpeg.decode_jpeg(picture.jpeg).astype(int)
            assert np.ptp(pixels, axis=2).max() <= 3  # without colour
            again = await anext(viewer)
            assert again.header["age_ms"] > picture.header["age_ms"]

    run(scenario)


def test_hub_close_ends_waiting_viewer(runtime):
    async def scenario() -> None:
        async with published(runtime) as (hub, _):
            viewers = [hub.subscribe("raw"), hub.subscribe("shown")]
            waiting = [asyncio.ensure_future(anext(viewer, None)) for viewer in viewers[:1]]
            await asyncio.sleep(0.05)
            await hub.close()
            assert await waiting[0] is None

    run(scenario)


def test_subscribe_rejects_quality_out_of_range(runtime):
    async def scenario() -> None:
        hub = DisplayHub(runtime.stream("a"))
        with pytest.raises(InvalidSetting):
            hub.subscribe("shown", 100)
        assert hub.counts("shown") == {}
        await hub.close()

    run(scenario)
