"""The process around the application: uvicorn on a socket of ours, with a bound on slow heads, and an end that drains."""

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

from services.control.certificate import ServerCertificate
from services.control.connections import AddressBound, BoundedListener
from services.control.errors import CannotServe
from services.control.handshakes import AnsweredHandshakes
from services.control.heads import MOST_HEAD_BYTES
from services.control.probe import ProbeListener
from services.control.state import ControlState
from services.control.system_events import SystemEvents
from services.control.systemd import ServiceManager
from services.settings import ServiceSettings

MOST_UNSENT_BYTES = 64 * 1024
"""What the system keeps of an answer that it has not sent yet: for a viewer who is slow the newest picture is to wait here, and not twenty old ones
there."""
MOST_MESSAGE_BYTES = 4096
"""Of what a viewer sends by WebSocket: nothing that anybody reads."""


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
        settings: where and as what it is served.
        listener: a socket that listens; see `bind`.
        listening: called with the server's address once it can be connected to.
        certificate: that of `certificate_of`, where the settings name one. New connections get its newest pair.
        probes: sockets from `bind_probe`.

    Raises:
        CannotServe: for a certificate that cannot be read, and where the application does not start.
    """
    config = config_of(app, settings)
    try:
        config.load()
    except OSError as error:  # ssl.SSLError is one
        raise CannotServe(f"TLS: {error}; check server.certfile and server.keyfile") from error
    if certificate is not None and config.ssl is not None:
        certificate.attach(config.ssl)
    # uvicorn raises the signal that ended it again, for whoever handled it before: a server that has drained has done what it was asked to.
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
    """Load the certificate that the settings name; None where they name none. Raises CannotServe."""
    if settings.server.certfile is None or settings.server.keyfile is None:
        return None
    try:
        return ServerCertificate(settings.server.certfile, settings.server.keyfile, events)
    except OSError as error:  # ssl.SSLError is one
        said = error.strerror or error
        raise CannotServe(f"TLS: {said}; check server.certfile and server.keyfile") from error


def config_of(app: FastAPI, settings: ServiceSettings) -> uvicorn.Config:
    """How uvicorn is run."""
    return uvicorn.Config(
        app,
        http=with_head_limits(settings.limits.head_s),
        loop="asyncio",  # it accepts by the listener's own method, which counts
        ws=AnsweredHandshakes,
        ws_max_size=MOST_MESSAGE_BYTES,
        ws_per_message_deflate=False,  # the pictures are compressed
        log_config=None,
        access_log=False,
        proxy_headers=False,  # the application has its own list of proxies
        server_header=False,
        limit_concurrency=settings.limits.connections,
        timeout_graceful_shutdown=max(1, round(settings.server.drain_s)),
        h11_max_incomplete_event_size=MOST_HEAD_BYTES,
        ssl_certfile=settings.server.certfile,
        ssl_keyfile=settings.server.keyfile,
    )


class DrainingServer(uvicorn.Server):
    """A server that tells the application at once that it is to end, so that displays without an end do so."""

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
        """Begin to take requests."""
        self._loop = asyncio.get_running_loop()
        await super().startup(sockets)
        if self.started:
            await self._probe.open()
            self._listening()
            self._manager.tell("READY=1", "STATUS=serving")
            self._feeding = self._loop.create_task(self._manager.feed_watchdog(), name="watchdog")

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drain; the probe listener says so to the end."""
        try:
            await super().shutdown(sockets)
        finally:
            await self._probe.close()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """The first signal drains; a second SIGINT ends at once."""
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._control.draining.set)
        self._manager.tell("STOPPING=1", "STATUS=ending")
        super().handle_exit(sig, frame)


def with_head_limits(head_s: float) -> type[H11Protocol]:
    """uvicorn's protocol with bounds on the head of a request: `head_s` until it is whole, where uvicorn waits for ever, and 431 for a long one."""

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
            """Answer what is no request, or too long to be one. h11 has not found the end of the head within its bound."""
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
    """A socket that listens where the settings say. Raises CannotServe for a port that is taken, and for a network without TLS."""
    server = settings.server
    _refuse_plaintext(settings)
    family = socket.AF_INET6 if ":" in server.host else socket.AF_INET
    try:
        listener = socket.create_server((server.host, server.port), family=family, backlog=256)
    except OSError as error:
        raise CannotServe(
            f"cannot listen on {server.host} port {server.port}: {error.strerror}; give another server.host or server.port"
        ) from error
    # Connections inherit both. asyncio turns Nagle's algorithm off only for sockets that name their protocol, and this one does not: an answer's
    # body would wait 40 ms for its head to be acknowledged.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # The system would take 4 MB for a viewer who is slow: seconds of pictures that are old before they are sent.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MOST_UNSENT_BYTES)
    # One whose peer takes nothing for so long is cut off by the system, whatever still waits to be sent.
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
    """The signal was seen to."""
