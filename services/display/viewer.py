"""One viewer of a stream: a slot for the newest picture."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Callable
from types import TracebackType

from services.display.encoder import EncodedPicture

SLOW = "slow client"
DEAD_S = 30.0
"""A viewer that takes no picture for so long is dropped."""


class Viewer(AsyncIterator[EncodedPicture]):
    """The newest picture, whenever the viewer is ready for one; those in between are counted and never seen. Used as

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
        """Pictures that the viewer took."""

    def offer(self, picture: EncodedPicture) -> None:
        """Put the newest picture there."""
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
        """Give no more pictures."""
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
