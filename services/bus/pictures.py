"""Pictures over ZeroMQ: published to any number of readers, none of whom slows the sender. The newest one wins.

A message is a JSON object and the pixels. Where the object says `"pixels": "frame"` a whole frame follows, in the pieces of
`operators/sources/zeromq_message.py` (what capture publishes); where it says `"rgb"` one part, uint8 [H, W, 3] of its `width_px` and `height_px` (what an
engine shows). Pixels are sent from where they lie: a copy of a 1920x1080 picture costs more than the socket (ADR 14).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from operators.sources import zeromq_message
from services.bus.errors import BadMessage
from services.bus.messages import MOST_BYTES, packed_json, parsed_json

HIGH_WATER = 4
"""Pictures that wait for a reader that does not keep up, on either side; what comes then is dropped for it. Readers take all that waits and use the
newest. Fewer would be lost to readers that do keep up: ZeroMQ takes note of what was read only now and then."""

MOST_PARTS = 2 + len(zeromq_message.ARRAYS)
"""Of a message."""


@dataclass(frozen=True)
class Picture:
    """A picture and what is said about it."""

    header: Mapping[str, Any]
    image: NDArray[np.uint8]
    """RGB uint8 [H, W, 3]."""


class PicturePublisher:
    """Publishes pictures at an endpoint. One thread at a time uses it."""

    kind = zmq.PUB

    def __init__(self, endpoint: str, context: zmq.Context | None = None) -> None:
        self._socket = (context or zmq.Context.instance()).socket(self.kind)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        self._socket.bind(endpoint)

    def publish_frame(self, header: Mapping[str, Any], pieces: Sequence[bytes | memoryview]) -> None:
        """Send a frame in the pieces of `zeromq_message`, which nobody may change any more; it never waits."""
        self._send({**header, "pixels": "frame"}, *pieces)

    def publish(self, header: Mapping[str, Any], image: NDArray[np.uint8]) -> None:
        """Send a picture, RGB uint8 [H, W, 3], which nobody may change any more; it never waits."""
        height_px, width_px = image.shape[:2]
        said = {**header, "pixels": "rgb", "width_px": width_px, "height_px": height_px}
        self._send(said, np.ascontiguousarray(image).data)

    def _send(self, header: Mapping[str, Any], *pixels: bytes | memoryview) -> None:
        # What has no reader, or whose reader does not keep up, is dropped by ZeroMQ here.
        self._socket.send_multipart([packed_json(header), *pixels], copy=False)

    def close(self) -> None:
        """Stop sending, and remove the socket."""
        self._socket.close()


def subscribe(socket: Any, *endpoints: str, waiting: int = HIGH_WATER) -> Any:
    """Make a SUB socket, plain or of asyncio, read pictures (or heartbeats) from endpoints, whether or not somebody is there yet."""
    options = {
        zmq.LINGER: 0,
        zmq.RCVHWM: waiting,
        zmq.MAXMSGSIZE: zeromq_message.MOST_BYTES,
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
    """The header and the pixels of a message. Raises BadMessage."""
    if not 2 <= len(parts) <= MOST_PARTS:
        raise BadMessage(f"a picture has 2 to {MOST_PARTS} parts, this message {len(parts)}")
    header, *pixels = (part.buffer for part in parts)
    if len(header) > MOST_BYTES:
        raise BadMessage(f"a picture's header has {len(header)} bytes; at most {MOST_BYTES} are read")
    return parsed_json(header), pixels


def picture_from(parts: Sequence[zmq.Frame]) -> Picture:
    """The picture of a message; its pixels look into the message's memory. Raises BadMessage."""
    header, pixels = split(parts)
    if header.get("pixels") == "frame":
        try:
            _, _, arrays = zeromq_message.unpacked_pieces(pixels)
        except zeromq_message.BadMessage as error:
            raise BadMessage(f"a frame cannot be read: {error}") from None
        return Picture(header, arrays["image"])
    width_px, height_px = (_side(header.get(name)) for name in ("width_px", "height_px"))
    size = sum(len(part) for part in pixels)
    if header.get("pixels") != "rgb" or len(pixels) != 1 or not 0 < 3 * width_px * height_px == size:
        raise BadMessage(
            f"a picture of {width_px}x{height_px} px cannot be made from {size} bytes of {header.get('pixels')!s:.20}"
        )
    return Picture(header, np.frombuffer(pixels[0], np.uint8).reshape(height_px, width_px, 3))


def _side(value: Any) -> int:
    """A side in pixels; 0 where it is none."""
    return value if type(value) is int and value > 0 else 0
