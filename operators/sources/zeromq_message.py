"""Frames as ZeroMQ messages, and a publisher of them for readers with `zmq+tcp://…` or `zmq+ipc://…`.

One frame is one message: a fixed header, then contiguous arrays. Connections to other machines must be encrypted (CURVE).

Binary format of one frame as one ZeroMQ message: a fixed header, then contiguous arrays.

| bytes | type | content | |---|---|---| | 0-3 | `ISPF` | | | 4-5 | uint16 | version, 1 | | 6-7 | uint16 | arrays
after the image, as bits: 1 right image, 2 depth, 4 mask, 8 pose | | 8-11, 12-15 | uint32 | width and height in pixels
| | 16-23 | uint64 | sequence number | | 24-31 | int64 | presentation timestamp in nanoseconds | | 32- | | arrays in
the order below |

The arrays are image uint8 [H, W, 3] RGB, right image of the same form, depth float32 [H, W] in mm, mask uint8 [H, W],
and pose float64 [4, 4] world to camera. All values are little-endian. Decoding never unpickles data.
"""

from __future__ import annotations

import ipaddress
import os
import struct
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import numpy as np
import zmq
import zmq.auth
from numpy.typing import NDArray
from zmq.auth.thread import ThreadAuthenticator

from gsplat_core.errors import InvalidSetting


def is_of_this_machine(endpoint: str) -> bool:
    """Return True if the endpoint is on this machine."""
    scheme, _, place = endpoint.partition("://")
    if scheme == "ipc":
        return True
    host = place.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def require_encryption(endpoint: str, encrypted: bool) -> None:
    """Raise InvalidSetting for an unencrypted endpoint on another machine."""
    if not encrypted and not is_of_this_machine(endpoint):
        raise InvalidSetting(
            f"{endpoint} leads to another machine, and patients' pictures do not go over a network in the clear; give keys "
            "(docs/sources.md, ZeroMQ), or stay on 127.0.0.1"
        )


def keys_from(path: str) -> tuple[bytes, bytes | None]:
    """Return public and secret key of a certificate file of `zmq.auth.create_certificates`. Raises
    InvalidSetting.
    """
    try:
        return zmq.auth.load_certificate(os.fspath(path))
    except (OSError, ValueError) as error:
        raise InvalidSetting(f"{path} is no certificate of ZeroMQ: {error}") from None


def connected(kind: int, endpoint: str, *, bind: bool, options: dict[int, Any]) -> tuple[zmq.Context, zmq.Socket]:
    """Create a socket in a new context and bind or connect it.

    Args:
        kind: ZeroMQ's socket type.
        endpoint: ZeroMQ endpoint.
        bind: bind the socket; otherwise connect it.
        options: socket options.

    Raises:
        InvalidSetting: the endpoint or an option is invalid.
    """
    context = zmq.Context()
    socket = context.socket(kind)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        for option, value in options.items():
            socket.setsockopt(option, value)
        if bind:
            socket.bind(endpoint)
        else:
            socket.connect(endpoint)
    except (zmq.ZMQError, ValueError) as error:
        socket.close()
        context.term()
        raise InvalidSetting(f"{endpoint} cannot be used: {error}") from None
    return context, socket


MAGIC, VERSION = b"ISPF", 1
HEADER = struct.Struct("<4sHHIIQq")
MOST_PIXELS = 2**24
"""Maximum number of pixels of a picture, 4096x4096, which bounds the size of a message."""
ARRAYS: Mapping[str, tuple[int, str, int]] = {
    "image": (0, "<u1", 3),
    "right_image": (1, "<u1", 3),
    "depth": (2, "<f4", 1),
    "mask": (4, "<u1", 1),
    "pose": (8, "<f8", 0),
}
"""Arrays by field, in order: bit in the header, data type, and values per pixel (0: 16 values in
all).
"""
MOST_BYTES = HEADER.size + MOST_PIXELS * (3 + 3 + 4 + 1) + 16 * 8


class BadMessage(Exception):
    """Reason that a message is not a valid frame."""


def packed(seq: int, pts_ns: int, arrays: Mapping[str, NDArray]) -> bytes:
    """Encode a frame as one message. Raises ValueError.

    Args:
        seq: sequence number.
        pts_ns: timestamp in nanoseconds.
        arrays: `image` [H, W, 3], and optionally the other arrays of the same size.
    """
    return b"".join(pieces(seq, pts_ns, arrays))


def pieces(seq: int, pts_ns: int, arrays: Mapping[str, NDArray]) -> list[bytes | memoryview]:
    """Encode a frame as a header and contiguous arrays.

    Contiguous arrays are not copied, so they must not be modified until the message is sent.

    Args:
        seq: sequence number.
        pts_ns: timestamp in nanoseconds.
        arrays: `image` [H, W, 3], and optionally the other arrays of the same size.

    Raises:
        ValueError: shapes do not match, or the picture is too large.
    """
    image = arrays["image"]
    height_px, width_px = image.shape[:2]
    if not 0 < width_px * height_px <= MOST_PIXELS:
        raise ValueError(f"a picture of {width_px}x{height_px} px is not sent; at most {MOST_PIXELS} pixels are")
    bits, found = 0, []
    for name, (bit, kind, values) in ARRAYS.items():
        if name not in arrays:
            continue
        array, shape = arrays[name], _shape(values, width_px, height_px)
        if array.shape != shape:
            raise ValueError(f"{name} is {list(array.shape)}; with this image it must be {list(shape)}")
        bits |= bit
        found.append(np.ascontiguousarray(array, kind).reshape(-1).view(np.uint8).data)
    return [HEADER.pack(MAGIC, VERSION, bits, width_px, height_px, seq, pts_ns), *found]


def unpacked(data: memoryview) -> tuple[int, int, dict[str, NDArray]]:
    """Decode a message into number, timestamp and arrays, which refer to its memory. Raises
    BadMessage.

    The header is validated before memory is allocated.
    """
    seq, pts_ns, announced = _announced(data)
    found: list[memoryview] = []
    begin = HEADER.size
    for name, _, _, size in announced:
        if begin + size > len(data):
            raise BadMessage(f"it ends within {name}: it has {len(data)} bytes")
        found.append(data[begin : begin + size])
        begin += size
    if begin != len(data):
        raise BadMessage(f"it has {len(data)} bytes; its header says {begin}")
    return seq, pts_ns, _arrays(announced, found)


def unpacked_pieces(data: Sequence[memoryview]) -> tuple[int, int, dict[str, NDArray]]:
    """Decode a message in pieces, as `unpacked` does. Raises BadMessage."""
    if not data:
        raise BadMessage("it has no pieces")
    if len(data[0]) != HEADER.size:
        raise BadMessage(f"its header has {len(data[0])} bytes in place of {HEADER.size}")
    seq, pts_ns, announced = _announced(data[0])
    sizes = [size for _, _, _, size in announced]
    if [len(piece) for piece in data[1:]] != sizes:
        raise BadMessage(f"its arrays have {[len(piece) for piece in data[1:]]} bytes; its header says {sizes}")
    return seq, pts_ns, _arrays(announced, data[1:])


_Announced = tuple[str, str, tuple[int, ...], int]


def _announced(data: memoryview) -> tuple[int, int, list[_Announced]]:
    """Return number and timestamp of a header, with name, type, shape and bytes of each array.
    Raises BadMessage.
    """
    if len(data) < HEADER.size:
        raise BadMessage(f"it has {len(data)} bytes, less than a header")
    magic, version, bits, width_px, height_px, seq, pts_ns = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise BadMessage(f"it begins with {bytes(magic)!r} in place of {MAGIC!r}")
    if version != VERSION:
        raise BadMessage(f"it has version {version}; {VERSION} is read")
    known = sum(bit for bit, _, _ in ARRAYS.values())
    if bits & ~known:
        raise BadMessage(f"it has arrays that are not known ({bits:#06x})")
    if not 0 < width_px * height_px <= MOST_PIXELS:
        raise BadMessage(f"its picture has {width_px}x{height_px} px; at most {MOST_PIXELS} pixels are read")
    if seq >= 2**62 or abs(pts_ns) >= 2**62:
        raise BadMessage(f"its number {seq} or its time {pts_ns} is out of range")
    announced = []
    for name, (bit, kind, values) in ARRAYS.items():
        if not bit or bits & bit:
            shape = _shape(values, width_px, height_px)
            announced.append((name, kind, shape, int(np.prod(shape)) * np.dtype(kind).itemsize))
    return seq, pts_ns, announced


def _arrays(announced: Sequence[_Announced], found: Sequence[memoryview]) -> dict[str, NDArray]:
    return {
        name: np.frombuffer(piece, kind).reshape(shape)
        for (name, kind, shape, _), piece in zip(announced, found, strict=True)
    }


def _shape(values: int, width_px: int, height_px: int) -> tuple[int, ...]:
    if values == 0:
        return 4, 4
    return (height_px, width_px) if values == 1 else (height_px, width_px, values)


class FramePublisher:
    """Publishes frames at an endpoint to any number of readers. A slow reader loses the oldest
    frames.

        with FramePublisher("tcp://127.0.0.1:5555") as publisher:
            publisher.publish(image, pts_ns=time.time_ns())

    A remote endpoint requires `certificate`, the secret key file of `zmq.auth.create_certificates`.
    `clients` is a folder with the public keys of permitted readers. Without it any reader that has
    the publisher's public key is permitted.
    """

    def __init__(self, endpoint: str, *, certificate: str | None = None, clients: str | None = None) -> None:
        """Bind the endpoint. Raises InvalidSetting for an unusable endpoint or keys.

        Args:
            endpoint: ZeroMQ endpoint.
            certificate: file with the secret key; None for no encryption.
            clients: folder with public keys of permitted readers; None for any reader.
        """
        require_encryption(endpoint, certificate is not None)
        options: dict[int, object] = {zmq.SNDHWM: 2}
        self._authenticator: ThreadAuthenticator | None = None
        if certificate is not None:
            public, secret = keys_from(certificate)
            if secret is None:
                raise InvalidSetting(f"{certificate} has no secret key; give the file that ends in .key_secret")
            options |= {zmq.CURVE_SERVER: 1, zmq.CURVE_PUBLICKEY: public, zmq.CURVE_SECRETKEY: secret}
        self._context, self._socket = connected(zmq.PUB, endpoint, bind=True, options=options)
        if certificate is not None:
            self._authenticator = ThreadAuthenticator(self._context)
            self._authenticator.start()
            self._authenticator.configure_curve(domain="*", location=clients or zmq.auth.CURVE_ALLOW_ANY)
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        """Bound endpoint, with the actual port for `tcp://…:*`."""
        self._seq = 0

    def publish(self, image: NDArray, *, pts_ns: int, seq: int | None = None, **arrays: NDArray | None) -> None:
        """Send one frame.

        Args:
            image: uint8 RGB [H, W, 3].
            pts_ns: timestamp in nanoseconds.
            seq: sequence number; None for the next one.
            arrays: any of `right_image`, `depth`, `mask` and `pose`, as in `Frame`.

        Raises:
            ValueError: shapes do not match, or the picture is too large.
        """
        seq = self._seq if seq is None else seq
        self._seq = seq + 1
        given = {name: array for name, array in arrays.items() if array is not None}
        self._socket.send(packed(seq, pts_ns, {"image": image, **given}))

    def close(self) -> None:
        """Close the socket and stop the authenticator."""
        if self._authenticator is not None:
            self._authenticator.stop()
        self._socket.close()
        self._context.term()

    def __enter__(self) -> FramePublisher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
