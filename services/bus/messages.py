"""Messages between the processes of a stream and the control plane over ZeroMQ: commands with answers, heartbeats and pictures.

Commands and heartbeats are one JSON object of limited size; nothing is ever unpickled. Heartbeats carry durations as histograms. A picture is a
JSON header followed by pixels, for any number of readers. A slow reader misses pictures and never delays the sender.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zmq
import zmq.asyncio
from numpy.typing import NDArray

from gsplat_core.errors import UserError
from gsplat_core.io.frame_codec import ARRAYS, MAX_PIECES, MAX_PIXELS, InvalidMessage, decode, encode
from gsplat_core.scene.frames import Frame
from services.errors import BadMessage, BusError, CommandRefused, NoAnswer

MOST_BYTES = 1 << 16
"""Largest size of a JSON message between processes, in bytes."""
MOST_NESTING = 64
"""Largest number of objects and lists inside each other. Python's own limit depends on its version."""


def packed_json(content: Mapping[str, Any]) -> bytes:
    """Encode a JSON object for a message.

    Raises:
        BadMessage: if it is too large or not representable in JSON.
    """
    try:
        data = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
    except (TypeError, ValueError) as error:
        raise BadMessage(f"this cannot be sent as JSON: {error}") from None
    if len(data) > MOST_BYTES:
        raise BadMessage(f"a message of {len(data)} bytes is not sent; at most {MOST_BYTES} are")
    return data


def parsed_json(data: bytes | memoryview) -> dict[str, Any]:
    """Decode a message's JSON object.

    Raises:
        BadMessage: if the data is too large, too deeply nested or no JSON object.
    """
    if len(data) > MOST_BYTES:
        raise BadMessage(f"a message of {len(data)} bytes is not read; at most {MOST_BYTES} are")
    text = bytes(data)
    try:
        content = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise BadMessage(f"{text[:40]!r} is not JSON: {error}") from None
    if not isinstance(content, dict):
        raise BadMessage(f"{text[:40]!r} is not a JSON object")
    inside: list[Any] = [content]
    for _ in range(MOST_NESTING):
        children = (each.values() if isinstance(each, dict) else each for each in inside)
        inside = [value for values in children for value in values if isinstance(value, dict | list)]
    if inside:
        raise BadMessage(f"{text[:40]!r} has more than {MOST_NESTING} objects and lists inside each other")
    return content


def _refuse(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")


log = logging.getLogger(__name__)
POLL_MS = 100
ANSWER_S = 2.0
Handler = Callable[[Mapping[str, Any]], Mapping[str, Any] | None]
"""Command handler: takes the arguments, returns the answer."""


def ask(endpoint: str, command: str, *, timeout_s: float = ANSWER_S, **arguments: Any) -> dict[str, Any]:
    """Send a command and wait for the answer.

    Args:
        endpoint: ZeroMQ address of the process.
        command: name of the command.
        timeout_s: seconds to wait.
        arguments: arguments of the command.

    Raises:
        NoAnswer: if the process does not answer in time.
        CommandRefused: with the reason, if the process refuses.
    """
    socket = _to(endpoint, zmq.Context.instance())
    try:
        socket.send(packed_json({"command": command, **arguments}))
        if not socket.poll(round(timeout_s * 1000)):
            raise _silence(endpoint, command, timeout_s)
        return _accepted(socket.recv())
    finally:
        socket.close()


async def ask_async(endpoint: str, command: str, *, timeout_s: float = ANSWER_S, **arguments: Any) -> dict[str, Any]:
    """Send a command like `ask`, in an event loop."""
    socket = _to(endpoint, zmq.asyncio.Context.instance())
    try:
        await socket.send(packed_json({"command": command, **arguments}))
        if not await socket.poll(round(timeout_s * 1000)):
            raise _silence(endpoint, command, timeout_s)
        return _accepted(await socket.recv())
    finally:
        socket.close()


def _to(endpoint: str, context: Any) -> Any:
    """Create a socket that is connected to a process, for one command."""
    socket = context.socket(zmq.REQ)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)
    socket.setsockopt(zmq.RECONNECT_IVL, 20)
    socket.connect(endpoint)
    return socket


def _silence(endpoint: str, command: str, timeout_s: float) -> NoAnswer:
    return NoAnswer(f"{endpoint} has not answered {command!r} within {timeout_s:g} s")


def _accepted(data: bytes) -> dict[str, Any]:
    answer = parsed_json(data)
    if answer.pop("ok", False) is not True:
        raise CommandRefused(str(answer.get("error", "it gave no reason")))
    return answer


class CommandServer:
    """Answers commands one at a time in its own thread."""

    def __init__(self, endpoint: str, handlers: Mapping[str, Handler]) -> None:
        self._handlers = handlers
        self._stop = threading.Event()
        self._socket: zmq.Socket = zmq.Context.instance().socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 200)  # send the answer to the command `stop` before the process ends
        self._socket.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)
        self._socket.bind(endpoint)
        self._thread = threading.Thread(target=self._serve, name="commands", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering commands and remove the socket."""
        self._stop.set()
        self._thread.join()

    def _serve(self) -> None:
        while not self._stop.is_set():
            if not self._socket.poll(POLL_MS):
                continue
            parts = self._socket.recv_multipart()
            answer = self._answer(b"".join(parts))
            self._socket.send(answer)
        self._socket.close()

    def _answer(self, data: bytes) -> bytes:
        try:
            request = parsed_json(data)
            name = request.pop("command", None)
            if name not in self._handlers:
                raise CommandRefused(f"there is no command {str(name)[:60]!r}; there are {', '.join(self._handlers)}")
            return packed_json({"ok": True, **(self._handlers[name](request) or {})})
        except (UserError, BusError) as error:
            return _refusal(str(error))
        except Exception as error:  # the client gets the error, and the process continues
            log.exception("command failed")
            return _refusal(f"{type(error).__name__}: {error}")


def _refusal(why: str) -> bytes:
    return packed_json({"ok": False, "error": why[:4000]})


def text_of(arguments: Mapping[str, Any], name: str) -> str:
    """Return a command's text argument.

    Raises:
        BadMessage: if the argument is missing, empty or no text.
    """
    value = arguments.get(name)
    if not isinstance(value, str) or not value:
        raise BadMessage(f"{name} is {value!r:.60}; it must be a text")
    return value


BOUNDS_S = (0.001, 0.0025, 0.005, 0.0083, 0.0167, 0.025, 0.0333, 0.05, 0.0667, 0.1, 0.15, 0.25, 0.5, 1.0, 5.0)
"""Upper bounds of the histogram buckets in seconds: 8.3, 16.7, 33.3 and 66.7 ms are one and two frames at 120, 60 and
30 frames/s. Longer durations are counted in a further bucket."""


class Durations:
    """Histogram of durations. One thread adds values; other threads may read, with counts that lag by at most one
    value."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def add(self, duration_s: float) -> None:
        """Add one duration to the histogram."""
        self._counts[bisect_left(BOUNDS_S, duration_s)] += 1
        self._sum_s += duration_s

    def as_json(self) -> dict[str, Any]:
        """Return the JSON form: the count of each bucket, the last without an upper bound, and the sum."""
        return {"counts": list(self._counts), "sum_s": round(self._sum_s, 6)}


def cumulative(durations: Any) -> tuple[list[tuple[str, float]], float] | None:
    """Convert the durations of a heartbeat to Prometheus buckets and their sum; None for malformed values."""
    counts = durations.get("counts") if isinstance(durations, Mapping) else None
    sum_s = durations.get("sum_s") if isinstance(durations, Mapping) else None
    whole = (
        isinstance(counts, list) and len(counts) == len(BOUNDS_S) + 1 and all(type(count) is int for count in counts)
    )
    if not whole or not isinstance(sum_s, int | float) or counts is None:
        return None
    found, total = [], 0
    for bound, count in zip((*map(str, BOUNDS_S), "+Inf"), counts, strict=True):
        total += count
        found.append((bound, float(total)))
    return found, float(sum_s)


PERIOD_S = 0.25


class Heartbeats:
    """Publisher of heartbeats: sends the result of `report` periodically from its own thread until closed."""

    def __init__(self, endpoint: str, report: Callable[[], Mapping[str, Any]]) -> None:
        self._report = report
        self._stop = threading.Event()
        self._now = threading.Event()
        self._socket: zmq.Socket = zmq.Context.instance().socket(zmq.PUB)
        self._socket.setsockopt(zmq.LINGER, 200)  # send the last heartbeat, which has the reason for the end
        self._socket.setsockopt(zmq.SNDHWM, 8)
        self._socket.bind(endpoint)
        self._thread = threading.Thread(target=self._beat, name="heartbeats", daemon=True)
        self._thread.start()

    def say_now(self) -> None:
        """Publish a heartbeat at once, after a change of the state."""
        self._now.set()

    def close(self) -> None:
        """Publish the last state and remove the socket."""
        self._stop.set()
        self._now.set()
        self._thread.join()

    def _beat(self) -> None:
        while True:
            last = self._stop.is_set()
            said = {"pid": os.getpid(), "sent_ns": time.monotonic_ns(), **self._report()}
            self._socket.send(packed_json(said))
            if last:
                break
            self._now.wait(PERIOD_S)
            self._now.clear()
        self._socket.close()


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
