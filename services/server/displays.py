"""Display hubs of all streams of a server."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from services.control.parts import PictureKind
from services.control.problems import Conflicting
from services.display.encoder import EncodedPicture
from services.server.streams import SupervisedStreams


class StreamDisplays:
    """Implementation of `services.control.parts.Display`."""

    def __init__(self, streams: SupervisedStreams) -> None:
        self._streams = streams

    @asynccontextmanager
    async def subscribe(
        self, stream: str, kind: PictureKind, quality: int
    ) -> AsyncIterator[AsyncIterator[EncodedPicture]]:
        """See `Display`.

        Raises:
            Conflicting: if the stream does not run.
        """
        hub = self._streams.hub(stream)
        if hub is None:
            raise Conflicting(f"the stream {stream} is stopped; start it first")
        async with hub.subscribe(kind, quality) as viewer:
            yield viewer
