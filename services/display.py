"""Distribution of a stream's pictures to viewers: each is encoded once per requested quality, and not at all without viewers.

A viewer holds the newest picture only, so a slow viewer skips pictures and delays no other.
"""

from __future__ import annotations

import asyncio
import json
import logging
import struct
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from types import TracebackType
from typing import Any, Literal

import numpy as np
import simplejpeg
import zmq
import zmq.asyncio
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from services.bus.messages import Durations, Picture, picture_from, subscribe
from services.bus.runtime import LAYERS, Layer, StreamFolder
from services.errors import BadMessage

LEAST_QUALITY, MOST_QUALITY = 10, 95
BOUNDARY = "picture"
"""Boundary between the pictures of a multipart answer."""
DIMMED_TO = 0.5
"""Brightness factor for pictures that must not be mistaken for live ones."""


@dataclass(frozen=True)
class EncodedPicture:
    """Encoded picture, shared by all viewers."""

    header: dict[str, object]
    """JSON header: `seq`, `pts_ns`, `arrived_ns`, `age_ms`, `state`; for reconstructions also `model_version`, `steps`,
    `psnr_db`, `previous_frame_db` and `next_frame_db` (docs/design/processes.md)."""
    jpeg: bytes

    @cached_property
    def message(self) -> bytes:
        """Return the picture as one message: header length (4 bytes, big-endian), JSON header, JPEG."""
        header = json.dumps(self.header, separators=(",", ":")).encode()
        return b"".join((struct.pack(">I", len(header)), header, self.jpeg))

    @cached_property
    def part(self) -> bytes:
        """Return the picture as a part of a multipart answer."""
        head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(self.jpeg)}\r\n\r\n"
        return b"".join((head.encode(), self.jpeg, b"\r\n"))


def check_quality(quality: int) -> int:
    """Return a JPEG quality if it is in range.

    Raises:
        InvalidSetting: if it is out of range.
    """
    if not LEAST_QUALITY <= quality <= MOST_QUALITY:
        raise InvalidSetting(f"quality is {quality}; it must be from {LEAST_QUALITY} to {MOST_QUALITY}")
    return quality


def encoded(image: NDArray[np.uint8], quality: int) -> bytes:
    """Encode RGB uint8 [H, W, 3] as JPEG, releasing the GIL."""
    pixels = np.ascontiguousarray(image)
    jpeg: bytes = simplejpeg.encode_jpeg(
        pixels, quality=quality, colorspace="RGB", colorsubsampling="420", fastdct=True
    )
    return jpeg


def dimmed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a darker greyscale copy of a picture, marking it as outdated."""
    grey = (image.astype(np.float32).mean(axis=2, keepdims=True) * DIMMED_TO).astype(np.uint8)
    return np.repeat(grey, 3, axis=2)


SLOW = "slow client"
DEAD_S = 30.0
"""Seconds after which a viewer that takes no picture is disconnected."""


class Viewer(AsyncIterator[EncodedPicture]):
    """Iterator of one viewer; each step waits for a picture and returns the newest. Skipped pictures are counted.

    async with hub.subscribe("shown") as viewer:
        async for picture in viewer: ...
    """

    def __init__(self, quality: int, leave: Callable[[Viewer], None], drops: Counter[str]) -> None:
        self.quality = quality
        self._leave, self._drops = leave, drops
        self._slot: EncodedPicture | None = None
        self._changed = asyncio.Event()
        self._closed = False
        self._taken_s = asyncio.get_running_loop().time()
        self.given = 0
        """Number of pictures that the viewer has taken."""

    def offer(self, picture: EncodedPicture) -> None:
        """Replace the pending picture by the newest one."""
        now_s = asyncio.get_running_loop().time()
        if self._slot is not None:
            self._drops[SLOW] += 1
            if now_s - self._taken_s > DEAD_S:
                self._drops["dead client"] += 1
                self.close()
                return
        self._slot = picture
        self._changed.set()

    def close(self) -> None:
        """End the viewer's iteration and unsubscribe it."""
        if not self._closed:
            self._closed = True
            self._leave(self)
            self._changed.set()

    async def __anext__(self) -> EncodedPicture:
        while self._slot is None:
            if self._closed:
                raise StopAsyncIteration
            self._changed.clear()
            await self._changed.wait()
        picture, self._slot = self._slot, None
        if self._closed:
            raise StopAsyncIteration
        self._taken_s = asyncio.get_running_loop().time()
        self.given += 1
        return picture

    async def __aenter__(self) -> Viewer:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


log = logging.getLogger(__name__)
PictureKind = Literal["raw", "shown", Layer]
KINDS: tuple[PictureKind, ...] = ("raw", "shown", *LAYERS)
"""Picture kinds. The hub receives each from the ZeroMQ socket of the same name."""
QUALITY = 80
STALE_S, FROZEN_S = 0.5, 1.0
"""Seconds without a picture from the stream process. After `STALE_S` the hub repeats the last picture dimmed; after
`FROZEN_S` it repeats it periodically with its current age."""
LAYER_STALE_S, LAYER_FROZEN_S = 1.5, 3.0
"""`STALE_S` and `FROZEN_S` of layer pictures, which the engine draws at low priority."""
REPEAT_S = 1.0


class DisplayHub:
    """Distributor of one stream's pictures to its viewers. For use in one event loop."""

    def __init__(self, folder: StreamFolder) -> None:
        self._folder = folder
        self._channels: dict[PictureKind, _Channel] = {}
        self._encoders = ThreadPoolExecutor(max_workers=2, thread_name_prefix="jpeg")

    def subscribe(self, kind: PictureKind, quality: int = QUALITY) -> Viewer:
        """Add a viewer, active until closed.

        Raises:
            InvalidSetting: if the quality is out of range.
        """
        check_quality(quality)
        channel = self._channels.get(kind)
        if channel is None:
            channel = self._channels[kind] = _Channel(self._folder.endpoint(kind), kind, self._encoders)
        return channel.add(quality)

    def viewers(self, kind: PictureKind) -> int:
        """Return the current number of viewers of a kind of picture."""
        channel = self._channels.get(kind)
        return 0 if channel is None else len(channel.viewers)

    def counts(self, kind: PictureKind) -> dict[str, int]:
        """Return the number of pictures `encoded`, and of pictures dropped for viewers, by reason; empty before a viewer."""
        channel = self._channels.get(kind)
        return {} if channel is None else dict(channel.counts)

    def ages(self, kind: PictureKind) -> Mapping[str, Any]:
        """Return the histogram of picture ages (time from frame arrival to encoding) as JSON values; empty before a viewer."""
        channel = self._channels.get(kind)
        return {} if channel is None else channel.ages.as_json()

    async def close(self) -> None:
        """Disconnect all viewers and stop the encoders."""
        for channel in self._channels.values():
            await channel.close()
        self._encoders.shutdown(wait=False)


class _Channel:
    """Distributor of one kind of a stream's pictures to its viewers. Subscribes to the stream process only while there
    are viewers.
    """

    def __init__(self, endpoint: str, kind: PictureKind, encoders: ThreadPoolExecutor) -> None:
        self._endpoint, self._kind, self._encoders = endpoint, kind, encoders
        self._stale_s, self._frozen_s = (LAYER_STALE_S, LAYER_FROZEN_S) if kind in LAYERS else (STALE_S, FROZEN_S)
        self.viewers: set[Viewer] = set()
        self.counts: Counter[str] = Counter()
        self.ages = Durations()
        self._task: asyncio.Task[None] | None = None

    def add(self, quality: int) -> Viewer:
        viewer = Viewer(quality, self._left, self.counts)
        self.viewers.add(viewer)
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._show(), name=f"display {self._kind}")
        return viewer

    def _left(self, viewer: Viewer) -> None:
        self.viewers.discard(viewer)
        if not self.viewers and self._task is not None:
            self._task.cancel()
            self._task = None

    async def close(self) -> None:
        task = self._task
        for viewer in list(self.viewers):
            viewer.close()
        if task is not None:
            await asyncio.gather(task, return_exceptions=True)

    async def _show(self) -> None:
        """Encode pictures and distribute them to the viewers until cancelled, when the last viewer leaves. While none arrive, repeat
        the last one dimmed."""
        socket = subscribe(zmq.asyncio.Context.instance().socket(zmq.SUB), self._endpoint)
        last: Picture | None = None
        came_s = time.monotonic()
        try:
            while True:
                picture = await self._newest(
                    socket, self._stale_s if last is None or time.monotonic() - came_s < self._frozen_s else REPEAT_S
                )
                now_s = time.monotonic()
                if picture is not None:
                    last, came_s = picture, now_s
                    await self._hand_out(_header(picture, self._kind), picture)
                elif last is not None:
                    state = "stale" if now_s - came_s < self._frozen_s else "frozen"
                    again = Picture({**_header(last, self._kind), "state": state, "new": False}, dimmed(last.image))
                    await self._hand_out(dict(again.header), again)
        finally:
            socket.close()

    async def _newest(self, socket: Any, timeout_s: float) -> Picture | None:
        """Return the newest pending picture; None after the timeout or a malformed message."""
        if not await socket.poll(round(timeout_s * 1000)):
            return None
        parts = await socket.recv_multipart(copy=False)
        while await socket.poll(0):
            self.counts["encoder busy"] += 1
            parts = await socket.recv_multipart(copy=False)
        try:
            return picture_from(parts)
        except BadMessage as error:
            self.counts["bad message"] += 1
            log.warning("%s: %s", self._endpoint, error)
            return None

    async def _hand_out(self, header: dict[str, object], picture: Picture) -> None:
        loop = asyncio.get_running_loop()
        for quality in {viewer.quality for viewer in self.viewers}:
            jpeg = await loop.run_in_executor(self._encoders, encoded, picture.image, quality)
            self.counts["encoded"] += 1
            said = EncodedPicture(header, jpeg)
            for viewer in [viewer for viewer in self.viewers if viewer.quality == quality]:
                viewer.offer(said)
        arrived_ns = header.get("arrived_ns")
        if isinstance(arrived_ns, int) and header.get("new", True):
            self.ages.add((time.monotonic_ns() - arrived_ns) * 1e-9)


def _header(picture: Picture, kind: PictureKind) -> dict[str, object]:
    """Return the header for viewers, with the current age."""
    header = {name: value for name, value in picture.header.items() if name not in ("pixels", "run")}
    arrived_ns = header.get("arrived_ns")
    if isinstance(arrived_ns, int):
        header["age_ms"] = round((time.monotonic_ns() - arrived_ns) * 1e-6, 3)
    height_px, width_px = picture.image.shape[:2]
    if kind == "raw":
        header["state"] = "live"
    return {**header, "picture": kind, "width_px": width_px, "height_px": height_px}
