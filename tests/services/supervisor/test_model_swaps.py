"""Finished models swapped in a running engine: each picture shows exactly the model of its header."""

from __future__ import annotations

import asyncio
import hashlib

import pytest
import torch
import zmq.asyncio

from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from services.bus.messages import picture_from, subscribe
from services.settings import StreamSettings
from services.supervisor.launcher import Direct
from services.supervisor.stream import Stream
from services.supervisor.worker import specs_of

pytestmark = pytest.mark.slow

SOON_S = 300.0
SWAPS = 12


@pytest.fixture
def bundles(tmp_path):
    """Two models that differ in every pixel: a red one and a blue one."""
    for version, colour in ((1, [[[2.0, -2, -2]]]), (2, [[[-2.0, -2, 2]]])):
        wall = Gaussians(
            *(torch.tensor(values) for values in ([[0.0, 0, 4]], [[1.0, 0, 0, 0]], [[3.0, 3, 0]], [6.0], colour))
        )
        save_bundle(Model(1, wall, None, Camera.from_focal(30.0, 32, 24), (0.0, 1.0)), tmp_path / str(version))
    return {version: tmp_path / str(version) for version in (1, 2)}


async def watch(endpoint: str, seen: list[tuple[str, int, str]]) -> None:
    """Append each displayed picture's kind, model version and digest to `seen`."""
    socket = subscribe(zmq.asyncio.Context.instance().socket(zmq.SUB), endpoint, waiting=256)
    try:
        while True:
            picture = picture_from(await socket.recv_multipart(copy=False))
            looks = hashlib.sha256(picture.image).hexdigest()
            seen.append((picture.header["show"], picture.header["model_version"], looks))
    finally:
        socket.close()


def test_pictures_during_model_swaps_show_only_named_version(runtime, bundles):
    async def scenario() -> None:
        source = "synthetic:?width=64&height=64&frames=3&fps=20"
        settings = StreamSettings(source=source, device="cpu", options={"engine_scale": 1})
        stream = Stream(settings, specs_of("a", settings), runtime, start=Direct())
        await stream.start()
        seen: list[tuple[str, int, str]] = []
        watching = asyncio.create_task(watch(stream.folder.pictures("engine"), seen))
        try:
            async with asyncio.timeout(SOON_S):
                while stream.engine.state.state != "running":
                    await asyncio.sleep(0.02)

                async def show(version: int) -> None:
                    where = {"folder": str(bundles[version]), "version": version, "name": "wall"}
                    await stream.engine.command("show_model", timeout_s=SOON_S, **where)
                    while not seen or seen[-1][:2] != ("model", version):
                        await asyncio.sleep(0.005)

                await show(1)
                began = next(index for index, each in enumerate(seen) if each[0] == "model")
                for swap in range(SWAPS):
                    if swap % 3 == 2:  # back to the one before, which is still in memory
                        version = (await stream.engine.command("show_previous"))["version"]
                        while seen[-1][:2] != ("model", version):
                            await asyncio.sleep(0.005)
                    else:
                        await show(2 - swap % 2)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
            await stream.stop()
        assert {each[0] for each in seen[began:]} == {"model"}, "nothing else was shown in between"
        looks = {version: {each[2] for each in seen[began:] if each[1] == version} for version in (1, 2)}
        assert all(len(each) == 1 for each in looks.values()) and looks[1] != looks[2]

    asyncio.run(scenario())
