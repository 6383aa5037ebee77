"""Frames of other programs over ZeroMQ: a source that receives them, `zmq+tcp://…` or `zmq+ipc://…`, and a publisher.

A message is one frame (`gsplat_core.io.frame_codec`). Connections to other machines must be encrypted (CURVE).
"""

from __future__ import annotations

import ipaddress
import math
import os
import time
from collections.abc import Iterator
from functools import partial
from types import TracebackType
from typing import Any

import zmq
import zmq.auth
from numpy.typing import NDArray
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils.monitor import recv_monitor_message

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.frame_codec import MAX_MESSAGE_BYTES, InvalidMessage, arrays_of, decode_message, encode_message
from gsplat_core.scene.frames import Frame
from operators.errors import SourceUnavailable
from operators.sources.address import OPEN_S, SourceOptions, ZeroMqAddress
from operators.sources.live import StreamSource


def is_of_this_machine(endpoint: str) -> bool:
    """Return True for an `ipc` endpoint, a loopback address or `localhost`."""
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
    """Return public and secret key of a certificate file of `zmq.auth.create_certificates`; the secret key is None in
    a public file. Raises InvalidSetting.
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
        self._socket.send(encode_message(seq, pts_ns, {"image": image, **given}))

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


POLL_MS = 50
NEW_SOCKET_S = 2.0
"""Time without a connection, in seconds, after which the socket is replaced."""


class ZeroMqSource(StreamSource):
    """Subscribes to a publisher of frames. ZeroMQ reconnects automatically, and `state` reports a
    lost connection.

    Messages that are not valid frames are dropped and counted (`bad_messages`).
    """

    def __init__(
        self, endpoint: str, curve: dict[int, bytes], fps: float | None, options: SourceOptions, open_s: float = OPEN_S
    ) -> None:
        """Connect and wait for the first frame.

        Args:
            endpoint: ZeroMQ endpoint.
            curve: ZeroMQ's encryption options; empty for none.
            fps: frame rate; None if unknown.
            options: source options.
            open_s: timeout for the first frame, in seconds.

        Raises:
            InvalidSetting: invalid endpoint or keys, or a remote endpoint without encryption.
            SourceUnavailable: no frame arrived in time.
        """
        require_encryption(endpoint, bool(curve))
        super().__init__(options)
        self._endpoint, self._curve = endpoint, curve
        self._name = f"zmq+{endpoint}"
        self._connect()
        try:
            first = self._first(time.monotonic() + open_s)
        except BaseException:
            self._disconnect()
            raise
        size = first.width_px, first.height_px
        fields = frozenset(arrays_of(first, ("right_image", "depth", "mask", "pose")))
        try:
            self.describe(self._name, size, fps, fields=fields)
        except InvalidSetting:
            self._disconnect()
            raise

    def open(self) -> None:
        """Connect the socket and start reading. Idempotent."""
        if self._socket is None:
            self._connect()
        super().open()

    def close(self) -> None:
        """Stop reading and close the socket. Idempotent."""
        super().close()
        self._disconnect()

    def pictures(self) -> Iterator[Frame]:
        """Yield the received frames, replacing the socket if it stays unconnected; see `StreamSource.pictures`."""
        for _ in range(2 * self.options.waiting):  # discard frames queued since the source was created
            self._next(0)
        while not self.wait(0):
            frame = self._next()
            if frame is not None:
                yield frame

    def _first(self, until_s: float) -> Frame:
        while time.monotonic() < until_s:
            frame = self._next()
            if frame is not None:
                return frame
        bad = self.counts().get("bad_messages", 0)
        what = f"{bad} messages came, and none is a frame" if bad else "no frame came"
        raise SourceUnavailable(f"{self._name} cannot be opened: {what}. Start what sends to it, and check the keys.")

    def _next(self, look_ms: int = POLL_MS) -> Frame | None:
        """Receive the next frame; None after a malformed message, or if none arrived within `look_ms` milliseconds."""
        assert self._socket is not None and self._monitor is not None
        found = dict(self._poller.poll(look_ms))
        now_s = time.monotonic()
        if self._monitor in found:
            if recv_monitor_message(self._monitor)["event"] == zmq.EVENT_DISCONNECTED:
                self._lost_s = now_s
                self.lost(f"the connection to {self._name} is lost; it is being re-established")
            else:
                self._lost_s = math.inf
        if self._socket not in found:
            if now_s - self._lost_s > NEW_SOCKET_S:  # false while connected, when it is infinite
                # A socket does not reconnect to a sender that broke the protocol, for example with
                # an oversized message.
                self._disconnect()
                self._connect()
            return None
        message = self._socket.recv(copy=False)  # may have been queued before the connection was lost
        now_ns = time.monotonic_ns()
        if self._socket.getsockopt(zmq.RCVMORE):  # a frame is a single part
            while self._socket.getsockopt(zmq.RCVMORE):
                self._socket.recv(copy=False)
            self.count("bad_messages")
            return None
        try:
            return decode_message(message.buffer, arrived_ns=now_ns)
        except InvalidMessage:
            self.count("bad_messages")
            return None

    def _connect(self) -> None:
        options = {
            zmq.RCVHWM: self.options.waiting,
            zmq.MAXMSGSIZE: MAX_MESSAGE_BYTES,
            zmq.RECONNECT_IVL: 250,
            zmq.RECONNECT_IVL_MAX: 2000,
            zmq.HEARTBEAT_IVL: 1000,
            zmq.HEARTBEAT_TIMEOUT: 3000,
            zmq.SUBSCRIBE: b"",
            **self._curve,
        }
        self._lost_s = math.inf
        self._context, socket = connected(zmq.SUB, self._endpoint, bind=False, options=options)
        self._socket: zmq.Socket | None = socket
        self._monitor: zmq.Socket | None = socket.get_monitor_socket(
            zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED
        )
        self._poller: zmq.Poller = zmq.Poller()
        self._poller.register(socket, zmq.POLLIN)
        self._poller.register(self._monitor, zmq.POLLIN)

    def _disconnect(self) -> None:
        socket, self._socket = self._socket, None
        if socket is None:
            return
        socket.disable_monitor()
        if self._monitor is not None:
            self._monitor.close(0)
            self._monitor = None
        socket.close(0)
        self._context.term()


def zeromq_source(transport: str, rest: str, options: SourceOptions) -> ZeroMqSource:
    """Open `zmq+tcp://127.0.0.1:5555?fps=30` or `zmq+ipc:///run/frames`.

    Remote endpoints require the certificates `server=FILE` and optionally `client=FILE`. Raises
    InvalidSetting and SourceUnavailable.
    """
    address = ZeroMqAddress.parse(f"zmq+{transport}", rest, options)
    server, client = address.server, address.client
    curve: dict[int, bytes] = {}
    if server is not None:
        curve[zmq.CURVE_SERVERKEY] = keys_from(server)[0]
        public, secret = zmq.curve_keypair() if client is None else keys_from(client)
        if secret is None:
            raise InvalidSetting(f"{client} has no secret key; give the file that ends in .key_secret")
        curve |= {zmq.CURVE_PUBLICKEY: public, zmq.CURVE_SECRETKEY: secret}
    elif client is not None:
        raise InvalidSetting("client=… needs server=…, the file with the sender's public key")
    return ZeroMqSource(f"{transport}://{address.place}", curve, address.fps, options, address.open_s)


tcp_source = partial(zeromq_source, "tcp")
ipc_source = partial(zeromq_source, "ipc")
