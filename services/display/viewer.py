"""Viewer of a stream: a slot for the newest picture."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Callable
from types import TracebackType

from services.display.encoder import EncodedPicture

SLOW = "slow client"
DEAD_S = 30.0
"""Seconds without a taken picture after which a viewer is dropped."""


class Viewer(AsyncIterator[EncodedPicture]):
    """Iterator over the newest picture at each step. Skipped pictures are counted.

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
        """Pictures taken by the viewer."""

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
        """End the iteration."""
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
