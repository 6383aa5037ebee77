"""Pictures produced only while they are read: the publisher detects its first and last reader."""

from __future__ import annotations

from collections.abc import Iterable

import zmq

from services.bus.pictures import PicturePublisher


class WatchedPublisher(PicturePublisher):
    """Publisher that knows whether readers are connected. For use by one thread."""

    kind = zmq.XPUB

    def __init__(self, endpoint: str, context: zmq.Context | None = None) -> None:
        super().__init__(endpoint, context)
        self._watched = False

    @property
    def watched(self) -> bool:
        """Return True if a reader is connected; a dead reader does not count."""
        while self._socket.poll(0):
            # Each message is one byte and the topic: 1 for the first reader, 0 after the last one
            # left.
            self._watched = self._socket.recv()[:1] == b"\x01"
        return self._watched


def wait_for_readers(publishers: Iterable[WatchedPublisher], timeout_s: float) -> None:
    """Wait until a reader connects to or leaves one of the publishers."""
    poller = zmq.Poller()
    for publisher in publishers:
        poller.register(publisher._socket, zmq.POLLIN)
    poller.poll(round(timeout_s * 1000))
