"""OpenIGTLink output of a stream: pictures, camera pose and state for 3D Slicer, PLUS and other programs.

Each client gets the newest message, and slow clients skip messages. Without clients the stream's socket is not read.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from operators.errors import OutputError
from services.bus.messages import Picture, picture_from, subscribe
from services.bus.runtime import StreamFolder
from services.errors import BadMessage

MOST_NAME = 20
"""Longest device name in the protocol."""
_LONGEST_ENDING = "_Camera"


def pyigtl() -> Any:
    """Import pyigtl.

    Raises:
        InvalidSetting: if it is not installed.
    """
    try:
        import pyigtl as library
    except ImportError:
        raise InvalidSetting("OpenIGTLink needs pyigtl; install it with: pip install 'intrasplat[igtl]'") from None
    return library


class StreamMessages:
    """Converts a stream's pictures to OpenIGTLink messages.

    Picture axes: i right, j down, k = 0, with three components (red, green, blue). A voxel is `spacing_mm` wide and
    high, and the origin is the picture's centre. Camera coordinates (x right, y down, z forward) are sent unchanged.
    The message declares them as RAS, because receivers would negate the x and y of LPS. They are not the patient's
    axes, which are unknown.

    Raises:
        InvalidSetting: if the name or the spacing is not valid.
    """

    def __init__(self, name: str, spacing_mm: float = 1.0) -> None:
        if not 1 <= len(name) <= MOST_NAME - len(_LONGEST_ENDING) or not name.isascii() or not name.isprintable():
            raise InvalidSetting(
                f"{name!r:.60} cannot be a device's name; take 1 to {MOST_NAME - len(_LONGEST_ENDING)} printable ASCII characters"
            )
        if not 1e-6 <= spacing_mm <= 1e6:
            raise InvalidSetting(f"the spacing is {spacing_mm:g} mm; it must be positive, from 1e-6 to 1e6")
        self._library = pyigtl()
        self._name, self._spacing_mm = name, spacing_mm

    def packed(self, header: Mapping[str, Any], image: NDArray[np.uint8]) -> bytes:
        """Pack IMAGE, TRANSFORM and STRING of a picture, RGB uint8 [H, W, 3], in this order."""
        at_s = taken_at(header)
        place = ijk_to_camera(image.shape[1], image.shape[0], self._spacing_mm)
        picture = self._library.ImageMessage(
            np.ascontiguousarray(image)[None], place, "ras", timestamp=at_s, device_name=self._name
        )
        pose = np.linalg.inv(np.asarray(header.get("world_to_camera") or np.eye(4), np.float64))
        camera = self._library.TransformMessage(pose, timestamp=at_s, device_name=f"{self._name}_Camera")
        said = f"{header.get('state', 'live')} {header.get('age_ms', 0):.0f} ms"
        return picture.pack() + camera.pack() + self.state(said, at_s)

    def state(self, said: str, at_s: float | None = None) -> bytes:
        """Pack a STRING message with the text `said`, the state of the picture, at Unix time `at_s` (None: now)."""
        message: bytes = self._library.StringMessage(
            said, timestamp=at_s or time.time(), device_name=f"{self._name}_State"
        ).pack()
        return message


def ijk_to_camera(width_px: int, height_px: int, spacing_mm: float) -> NDArray[np.float64]:
    """Return the 4x4 matrix from voxel indices to camera coordinates, with the origin at the picture's centre."""
    place = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    place[:2, 3] = -0.5 * spacing_mm * np.array([width_px - 1, height_px - 1])
    return place


def taken_at(header: Mapping[str, Any]) -> float:
    """Return the arrival time of a picture's newest frame as Unix time in seconds."""
    arrived_ns = header.get("arrived_ns")
    since_s = (time.monotonic_ns() - arrived_ns) * 1e-9 if isinstance(arrived_ns, int) else 0.0
    return time.time() - since_s


log = logging.getLogger(__name__)
MOST_CLIENTS = 16
STALLED_S = 10.0
"""Seconds after which a client that accepts no data is dropped."""


class MessageServer:
    """Server that sends each client the newest message once the previous one is sent."""

    def __init__(self, host: str, port: int) -> None:
        """Start to listen at an address.

        Raises:
            OutputError: if that fails.
        """
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise OutputError(
                f"{host}:{port} cannot be listened on: {error.strerror or error}; choose another --port"
            ) from error
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._changed = threading.Condition()
        self._message, self._number = b"", 0
        self._clients: set[socket.socket] = set()
        self._closed = False
        self._accepting = threading.Thread(target=self._accept, name="igtl listen", daemon=True)
        self._accepting.start()

    @property
    def clients(self) -> int:
        """Return the number of connected clients."""
        with self._changed:
            return len(self._clients)

    def send(self, message: bytes) -> None:
        """Set the newest message; returns at once."""
        with self._changed:
            self._message, self._number = message, self._number + 1
            self._changed.notify_all()

    def close(self) -> None:
        """Disconnect all clients."""
        with self._changed:
            self._closed = True
            clients = list(self._clients)
            self._changed.notify_all()
        for client in [self._listener, *clients]:
            with contextlib.suppress(OSError):  # already disconnected
                client.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._accepting.join()

    def _accept(self) -> None:
        while True:
            try:
                client, address = self._listener.accept()
            except OSError:
                return  # `close` has closed the listening socket
            with self._changed:
                full = self._closed or len(self._clients) >= MOST_CLIENTS
                if not full:
                    self._clients.add(client)
            if full:
                log.warning("%s is refused: %d clients are connected already", address[0], MOST_CLIENTS)
                client.close()
                continue
            log.info("%s is connected", address[0])
            threading.Thread(target=self._serve, args=(client,), name="igtl client", daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.settimeout(STALLED_S)
        sent = 0
        try:
            while (waiting := self._newer_than(sent, client)) is not None:
                sent, message = waiting
                if message:
                    client.sendall(message)
        except OSError as error:
            log.info("a client has left: %s", error)
        finally:
            with self._changed:
                self._clients.discard(client)
            client.close()

    def _newer_than(self, sent: int, client: socket.socket) -> tuple[int, bytes] | None:
        """Wait for a message newer than number `sent`. Return its number and bytes; `(sent, b"")` after a timeout;
        None if the client has disconnected or the server closes."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._number > sent, 0.5)
            if self._closed:
                return None
            found = (self._number, self._message) if self._number > sent else (sent, b"")
        return None if _has_left(client) else found


def _has_left(client: socket.socket) -> bool:
    """Return True if the client has closed the connection. Received data, such as requests, is discarded."""
    while select.select([client], [], [], 0)[0]:
        if not client.recv(65536):
            return True
    return False


POLL_MS = 100
SILENT_S = 1.0


def folder_of(runtime: Path, stream: str) -> StreamFolder:
    """Return the folder of a running stream.

    Raises:
        InvalidSetting: if the stream does not run.
        RuntimeFolderUnusable: if the folder cannot be used.
    """
    path = runtime / stream
    if "/" in stream or not path.is_dir():
        raise InvalidSetting(
            f"no stream {stream!r:.60} runs in {runtime}; start it, or give the service's --config or --runtime"
        )
    return StreamFolder(path)


def send(
    endpoint: str, messages: StreamMessages, server: MessageServer, stop_requested: Callable[[], bool]
) -> dict[str, int]:
    """Send pictures until a stop is requested.

    Returns:
        Numbers of sent and of unreadable pictures.
    """
    counts = {"sent": 0, "bad": 0}
    while not stop_requested():
        if not server.clients:
            time.sleep(POLL_MS / 1000)
            continue
        with subscribe(zmq.Context.instance().socket(zmq.SUB), endpoint) as socket:
            _send_while_watched(socket, messages, server, stop_requested, counts)
    return counts


def _send_while_watched(
    socket: zmq.Socket,
    messages: StreamMessages,
    server: MessageServer,
    stop_requested: Callable[[], bool],
    counts: dict[str, int],
) -> None:
    heard_s = time.monotonic()
    while server.clients and not stop_requested():
        picture = _newest(socket, counts)
        now_s = time.monotonic()
        if picture is not None:
            heard_s = now_s
            server.send(messages.packed(picture.header, picture.image))
            counts["sent"] += 1
        elif now_s - heard_s > SILENT_S:
            heard_s = now_s
            server.send(messages.state("no picture"))


def _newest(socket: zmq.Socket, counts: dict[str, int]) -> Picture | None:
    if not socket.poll(POLL_MS):
        return None
    parts = socket.recv_multipart(copy=False)
    while socket.poll(0):
        parts = socket.recv_multipart(copy=False)
    try:
        return picture_from(parts)
    except BadMessage:
        counts["bad"] += 1
        return None
