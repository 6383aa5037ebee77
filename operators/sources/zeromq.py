"""Source that receives frames from another program over ZeroMQ (see
`zeromq_publisher.FramePublisher`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from functools import partial

import zmq
from zmq.utils.monitor import recv_monitor_message

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import Frame
from operators.errors import SourceUnavailable
from operators.sources.address_options import OPEN_S, ZeroMqAddress
from operators.sources.options import SourceOptions
from operators.sources.stream import StreamSource
from operators.sources.zeromq_message import MOST_BYTES, BadMessage, connected, keys_from, require_encryption, unpacked

LOOK_MS = 50
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
        fields = frozenset(
            name for name in ("right_image", "depth", "mask", "pose") if getattr(first, name) is not None
        )
        try:
            self.describe(self._name, size, fps, fields=fields)
        except InvalidSetting:
            self._disconnect()
            raise

    def open(self) -> None:
        """See `FrameSource`."""
        if self._socket is None:
            self._connect()
        super().open()

    def close(self) -> None:
        """See `FrameSource`."""
        super().close()
        self._disconnect()

    def pictures(self) -> Iterator[Frame]:
        """See `StreamSource`."""
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

    def _next(self, look_ms: int = LOOK_MS) -> Frame | None:
        """Receive the next frame; None if none arrived within `look_ms` milliseconds."""
        assert self._socket is not None and self._monitor is not None
        found = dict(self._poller.poll(look_ms))
        now_s = time.monotonic()
        if self._monitor in found and recv_monitor_message(self._monitor)["event"] == zmq.EVENT_DISCONNECTED:
            self._lost_s = now_s
            self.lost(f"the connection to {self._name} is lost; it is being made again")
        if self._socket not in found:
            if now_s - self._lost_s > NEW_SOCKET_S:  # never true while it is infinite
                # A socket does not reconnect to a sender that broke the protocol, for example with
                # an oversized message.
                self._disconnect()
                self._connect()
            return None
        self._lost_s = math.inf
        message = self._socket.recv(copy=False)
        now_ns = time.monotonic_ns()
        if self._socket.getsockopt(zmq.RCVMORE):  # a frame is a single part
            while self._socket.getsockopt(zmq.RCVMORE):
                self._socket.recv(copy=False)
            self.count("bad_messages")
            return None
        try:
            seq, pts_ns, arrays = unpacked(message.buffer)
        except BadMessage:
            self.count("bad_messages")
            return None
        return Frame(seq=seq, pts_ns=pts_ns, arrived_ns=now_ns, **arrays)  # type: ignore[arg-type]

    def _connect(self) -> None:
        options = {
            zmq.RCVHWM: self.options.waiting,
            zmq.MAXMSGSIZE: MOST_BYTES,
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
        self._monitor: zmq.Socket | None = socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
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
