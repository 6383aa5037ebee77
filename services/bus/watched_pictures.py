"""Pictures that are made only while somebody reads them: the publisher hears when its first reader comes and when the last one has left."""

from __future__ import annotations

from collections.abc import Iterable

import zmq

from services.bus.pictures import PicturePublisher


class WatchedPublisher(PicturePublisher):
    """Publishes pictures at an endpoint, and knows whether anybody reads them. One thread uses it."""

    kind = zmq.XPUB

    def __init__(self, endpoint: str, context: zmq.Context | None = None) -> None:
        super().__init__(endpoint, context)
        self._watched = False

    @property
    def watched(self) -> bool:
        """Whether anybody reads: a reader that dies has left."""
        while self._socket.poll(0):
            # One byte and the topic: 1 for the first reader, 0 when the last one has left.
            self._watched = self._socket.recv()[:1] == b"\x01"
        return self._watched


def wait_for_readers(publishers: Iterable[WatchedPublisher], timeout_s: float) -> None:
    """Wait until a reader comes to one of them or leaves it."""
    poller = zmq.Poller()
    for publisher in publishers:
        poller.register(publisher._socket, zmq.POLLIN)
    poller.poll(round(timeout_s * 1000))
