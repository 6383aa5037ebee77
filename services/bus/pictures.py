"""Pictures over ZeroMQ, published to any number of readers. A slow reader misses pictures and never delays the sender.

`WatchedPublisher` detects its first and its last reader, so that pictures without readers are not produced.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from gsplat_core.io.frame_codec import ARRAYS, MAX_PIECES, MAX_PIXELS, InvalidMessage, decode, encode
from gsplat_core.scene.frames import Frame
from services.bus.messages import MOST_BYTES, packed_json, parsed_json
from services.errors import BadMessage

HIGH_WATER = 4
"""Pictures queued per reader on either side; further ones are dropped for that reader. Readers
drain the queue and use the newest picture. A smaller value would lose pictures of fast readers,
because ZeroMQ updates its count of delivered messages with a delay."""
MAX_PARTS = 1 + MAX_PIECES
MAX_PART_BYTES = max(np.dtype(array.kind).itemsize * array.values for array in ARRAYS.values()) * MAX_PIXELS
"""Largest size in bytes of a part of a message: the pixels of the largest picture."""


@dataclass(frozen=True)
class Picture:
    """Picture received from a publisher, with its header."""

    header: Mapping[str, Any]
    image: NDArray[np.uint8]
    """Pixels, RGB uint8 [H, W, 3]."""


class PicturePublisher:
    """Publisher of pictures at an endpoint. For use by one thread at a time."""

    kind = zmq.PUB

    def __init__(self, endpoint: str, context: zmq.Context | None = None) -> None:
        self._socket = (context or zmq.Context.instance()).socket(self.kind)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        self._socket.bind(endpoint)

    def publish_frame(self, header: Mapping[str, Any], frame: Frame) -> None:
        """Send a frame without blocking. Its arrays must not be modified afterwards."""
        self._send({**header, "pixels": "frame"}, *encode(frame))

    def publish(self, header: Mapping[str, Any], image: NDArray[np.uint8]) -> None:
        """Send a picture, RGB uint8 [H, W, 3], without blocking. The array must not be modified afterwards."""
        height_px, width_px = image.shape[:2]
        said = {**header, "pixels": "rgb", "width_px": width_px, "height_px": height_px}
        self._send(said, np.ascontiguousarray(image).data)

    def _send(self, header: Mapping[str, Any], *pixels: bytes | memoryview) -> None:
        # ZeroMQ drops the message here for missing or slow readers.
        self._socket.send_multipart([packed_json(header), *pixels], copy=False)

    def close(self) -> None:
        """Stop sending and remove the socket."""
        self._socket.close()


def subscribe(socket: Any, *endpoints: str, waiting: int = HIGH_WATER) -> Any:
    """Connect a SUB socket (plain or asyncio) to endpoints of pictures or heartbeats. The publishers may start later.

    Args:
        socket: the socket.
        endpoints: ZeroMQ addresses.
        waiting: queue length.

    Returns:
        The socket.
    """
    options = {
        zmq.LINGER: 0,
        zmq.RCVHWM: waiting,
        zmq.MAXMSGSIZE: MAX_PART_BYTES,
        zmq.RECONNECT_IVL: 20,
        zmq.RECONNECT_IVL_MAX: 0,
        zmq.SUBSCRIBE: b"",
    }
    for option, value in options.items():
        socket.setsockopt(option, value)
    for endpoint in endpoints:
        socket.connect(endpoint)
    return socket


def split(parts: Sequence[zmq.Frame]) -> tuple[dict[str, Any], list[memoryview]]:
    """Split a message into header and pixels.

    Raises:
        BadMessage: if the message is malformed.
    """
    if not 2 <= len(parts) <= MAX_PARTS:
        raise BadMessage(f"a picture has 2 to {MAX_PARTS} parts, this message {len(parts)}")
    header, *pixels = (part.buffer for part in parts)
    if len(header) > MOST_BYTES:
        raise BadMessage(f"a picture's header has {len(header)} bytes; at most {MOST_BYTES} are read")
    return parsed_json(header), pixels


def frame_from(parts: Sequence[zmq.Frame]) -> tuple[dict[str, Any], Frame]:
    """Return header and frame of a message; the frame's arrays reference the message's memory.

    Raises:
        BadMessage: if the message is malformed or has no frame.
    """
    header, pixels = split(parts)
    if header.get("pixels") != "frame":
        raise BadMessage(f"a message with {header.get('pixels')!s:.20} pixels has no frame")
    return header, _decoded(pixels)


def _decoded(pixels: Sequence[memoryview]) -> Frame:
    try:
        return decode(pixels)
    except InvalidMessage as error:
        raise BadMessage(f"a frame cannot be read: {error}") from None


def picture_from(parts: Sequence[zmq.Frame]) -> Picture:
    """Return the picture of a message; its pixels reference the message's memory. The header of a frame has its number,
    times and status.

    Raises:
        BadMessage: if the message is malformed.
    """
    header, pixels = split(parts)
    if header.get("pixels") == "frame":
        frame = _decoded(pixels)
        stated = {name: getattr(frame, name) for name in ("seq", "pts_ns", "arrived_ns", "damage")}
        return Picture({**header, **stated, "status": frame.status.value}, frame.image)
    width_px, height_px = (_side(header.get(name)) for name in ("width_px", "height_px"))
    size = sum(len(part) for part in pixels)
    if header.get("pixels") != "rgb" or len(pixels) != 1 or not 0 < 3 * width_px * height_px == size:
        raise BadMessage(
            f"a picture of {width_px}x{height_px} px cannot be made from {size} bytes of {header.get('pixels')!s:.20}"
        )
    return Picture(header, np.frombuffer(pixels[0], np.uint8).reshape(height_px, width_px, 3))


def _side(value: Any) -> int:
    """Return a side length in pixels, or 0 if the value is not valid."""
    return value if type(value) is int and value > 0 else 0


class WatchedPublisher(PicturePublisher):
    """Picture publisher that detects connected readers. For use by one thread."""

    kind = zmq.XPUB

    def __init__(self, endpoint: str, context: zmq.Context | None = None) -> None:
        super().__init__(endpoint, context)
        self._watched = False

    @property
    def watched(self) -> bool:
        """True while at least one living reader is connected."""
        while self._socket.poll(0):
            # Each message is one byte and the topic: 1 for the first reader, 0 after the last one left.
            self._watched = self._socket.recv()[:1] == b"\x01"
        return self._watched


def wait_for_readers(publishers: Iterable[WatchedPublisher], timeout_s: float) -> None:
    """Wait up to `timeout_s` seconds until a reader connects to or leaves one of the publishers."""
    poller = zmq.Poller()
    for publisher in publishers:
        poller.register(publisher._socket, zmq.POLLIN)
    poller.poll(round(timeout_s * 1000))
