"""Server process around the application: uvicorn on a bound socket, with request head limits and a
draining shutdown."""

from __future__ import annotations

import asyncio
import ipaddress
import signal
import socket
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from services.audit.system_events import SystemEvents
from services.control.certificate import ServerCertificate
from services.control.connections import AddressBound, BoundedListener
from services.control.handshakes import AnsweredHandshakes
from services.control.heads import MOST_HEAD_BYTES
from services.control.probe import ProbeListener
from services.control.state import ControlState
from services.control.systemd import ServiceManager
from services.errors import CannotServe
from services.settings import ServiceSettings

MOST_UNSENT_BYTES = 64 * 1024
"""Unsent bytes that the kernel buffers per connection. A small buffer keeps old pictures from
queueing for a slow viewer."""
MOST_MESSAGE_BYTES = 4096
"""Largest WebSocket message accepted from a viewer. The server ignores the content."""


def serve(
    app: FastAPI,
    settings: ServiceSettings,
    listener: socket.socket,
    listening: Callable[[str], None],
    certificate: ServerCertificate | None = None,
    probes: Sequence[socket.socket] = (),
) -> None:
    """Serve until SIGTERM or SIGINT, then drain.

    Args:
        app: the application.
        settings: address, TLS and limits.
        listener: listening socket from `bind`.
        listening: called with the server's address once connections are accepted.
        certificate: result of `certificate_of`. New connections use its newest pair.
        probes: sockets from `bind_probe`.

    Raises:
        CannotServe: if the certificate cannot be read or the application does not start.
    """
    config = config_of(app, settings)
    try:
        config.load()
    except OSError as error:  # includes ssl.SSLError
        raise CannotServe(f"TLS: {error}; check server.certfile and server.keyfile") from error
    if certificate is not None and config.ssl is not None:
        certificate.attach(config.ssl)
    # uvicorn re-raises the signal for the previous handler after shutdown. A drained server must
    # exit normally instead.
    signal.signal(signal.SIGTERM, _done)
    signal.signal(signal.SIGINT, _done)
    control: ControlState = app.state.control
    refused = control.measures.refused.labels("connections")
    bound = AddressBound(settings.limits.connections_per_address, settings.server.trusted_proxies, refused.inc)
    probe = ProbeListener(control, probes)
    with BoundedListener.of(listener, bound) as bounded:
        server = DrainingServer(config, control, lambda: listening(_address(bounded, settings)), probe)
        server.run(sockets=[bounded])
    if not server.started:
        raise CannotServe("the server could not start; its log says why")


def certificate_of(settings: ServiceSettings, events: SystemEvents) -> ServerCertificate | None:
    """Load the certificate that the settings name.

    Returns:
        The certificate, or None if the settings name none.

    Raises:
        CannotServe: if it cannot be loaded.
    """
    if settings.server.certfile is None or settings.server.keyfile is None:
        return None
    try:
        return ServerCertificate(settings.server.certfile, settings.server.keyfile, events)
    except OSError as error:  # includes ssl.SSLError
        said = error.strerror or error
        raise CannotServe(f"TLS: {said}; check server.certfile and server.keyfile") from error


def config_of(app: FastAPI, settings: ServiceSettings) -> uvicorn.Config:
    """Return the uvicorn configuration."""
    return uvicorn.Config(
        app,
        http=with_head_limits(settings.limits.head_s),
        loop="asyncio",  # asyncio accepts through the listener's `accept`, which counts connections
        ws=AnsweredHandshakes,
        ws_max_size=MOST_MESSAGE_BYTES,
        ws_per_message_deflate=False,  # the pictures are already compressed
        log_config=None,
        access_log=False,
        proxy_headers=False,  # the application has its own list of trusted proxies
        server_header=False,
        limit_concurrency=settings.limits.connections,
        timeout_graceful_shutdown=max(1, round(settings.server.drain_s)),
        h11_max_incomplete_event_size=MOST_HEAD_BYTES,
        ssl_certfile=settings.server.certfile,
        ssl_keyfile=settings.server.keyfile,
    )


class DrainingServer(uvicorn.Server):
    """uvicorn server that signals the drain to the application at once, so that endless displays
    end."""

    def __init__(
        self,
        config: uvicorn.Config,
        control: ControlState,
        listening: Callable[[], None],
        probe: ProbeListener | None = None,
    ) -> None:
        super().__init__(config)
        self._control = control
        self._probe = probe or ProbeListener(control, ())
        self._listening = listening
        self._loop: asyncio.AbstractEventLoop | None = None
        self._manager = ServiceManager()
        self._feeding: asyncio.Task[None] | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start accepting requests; notify systemd and start its watchdog task."""
        self._loop = asyncio.get_running_loop()
        await super().startup(sockets)
        if self.started:
            await self._probe.open()
            self._listening()
            self._manager.tell("READY=1", "STATUS=serving")
            self._feeding = self._loop.create_task(self._manager.feed_watchdog(), name="watchdog")

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drain. The probe listener answers until the end."""
        try:
            await super().shutdown(sockets)
        finally:
            await self._probe.close()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Drain on the first signal; end at once on a second SIGINT."""
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._control.draining.set)
        self._manager.tell("STOPPING=1", "STATUS=ending")
        super().handle_exit(sig, frame)


def with_head_limits(head_s: float) -> type[H11Protocol]:
    """Return uvicorn's HTTP protocol with limits on the request head.

    The head must be complete within `head_s`; uvicorn itself sets no such limit. A head that is too
    long gets 431.

    Args:
        head_s: time limit in seconds.
    """

    class HeadLimits(H11Protocol):
        _timer: asyncio.TimerHandle | None = None

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._watch()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._watch()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop_watching()
            super().connection_lost(exc)

        def _watch(self) -> None:
            if self.conn.their_state is not h11.IDLE:
                self._stop_watching()
            elif self._timer is None:
                self._timer = self.loop.call_later(head_s, self._close)

        def _stop_watching(self) -> None:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None

        def send_400_response(self, msg: str) -> None:
            """Answer a malformed request with 400, or with 431 if h11 found no end of the head
            within its limit."""
            if len(self.conn.trailing_data[0]) <= MOST_HEAD_BYTES:
                super().send_400_response(msg)
                return
            self._stop_watching()
            body = b"the head of the request is too long"
            headers = [
                ("content-type", "text/plain; charset=utf-8"),
                ("connection", "close"),
                ("content-length", str(len(body))),
            ]
            for event in (h11.Response(status_code=431, headers=headers), h11.Data(data=body), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
            self.transport.close()

        def _close(self) -> None:
            if self.conn.their_state is h11.IDLE and not self.transport.is_closing():
                self.transport.close()

    return HeadLimits


def bind(settings: ServiceSettings) -> socket.socket:
    """Bind the listening socket at the configured address.

    Raises:
        CannotServe: if the port is in use, or the address is reachable from the network without
            TLS.
    """
    server = settings.server
    _refuse_plaintext(settings)
    family = socket.AF_INET6 if ":" in server.host else socket.AF_INET
    try:
        listener = socket.create_server((server.host, server.port), family=family, backlog=256)
    except OSError as error:
        raise CannotServe(
            f"cannot listen on {server.host} port {server.port}: {error.strerror}; give another server.host or server.port"
        ) from error
    # Accepted connections inherit these options. asyncio disables Nagle's algorithm only for
    # sockets with an explicit protocol, which this one lacks. An answer's body would otherwise wait
    # 40 ms for the acknowledgement of its head.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # The kernel would buffer up to 4 MB per slow viewer, which is seconds of outdated pictures.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MOST_UNSENT_BYTES)
    # The kernel drops a connection whose peer acknowledges nothing for this time.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(settings.limits.viewer_stall_s * 1000))
    return listener


def _refuse_plaintext(settings: ServiceSettings) -> None:
    server = settings.server
    if server.certfile is None and not server.plaintext and not _is_loopback(server.host):
        raise CannotServe(
            f"server.host is {server.host}, which others reach, without TLS: keys would travel in the clear; give server.certfile and"
            " server.keyfile, or server.plaintext: true where something before this server does TLS"
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _address(listener: socket.socket, settings: ServiceSettings) -> str:
    host, port = listener.getsockname()[:2]
    scheme = "http" if settings.server.certfile is None else "https"
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"


def _done(number: int, frame: FrameType | None) -> None:
    """Ignore a signal that was already handled."""
