"""Server process around the application: uvicorn on a bound socket with limits on connections and request heads, orderly drain, systemd, and the TLS certificate.

The certificate is loaded again when its files change. Its expiry is in /readyz and in the metrics.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import os
import re
import signal
import socket
import ssl
import sys
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, MutableMapping, Sequence
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import SecurityError

from services.api.guard import MOST_HEAD_BYTES, network_of_address
from services.api.service import ProbeListener
from services.api.state import ControlState
from services.audit.log import SystemEvents
from services.errors import CannotServe
from services.schemas import CheckResult
from services.settings import ServiceSettings, is_loopback

log = logging.getLogger(__name__)
TOO_LONG = 431
HEAD_TOO_LONG = f"the head of the request has more than {MOST_HEAD_BYTES} bytes; send a shorter one"
CANNOT_BE_READ = "the WebSocket handshake cannot be read; send a GET request with the headers of RFC 6455 and no body"
TOO_LARGE = "the head of the WebSocket handshake has too many or too long lines; send at most 128 lines of 8192 bytes"


class AnsweredHandshakes(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket protocol, extended to answer every handshake that the parser refuses.

    uvicorn neither answers nor closes such a connection, so it would stay open until the client closes it.
    """

    def data_received(self, data: bytes) -> None:
        """Parse received bytes. Answer 431 or 400 if the parser refused the handshake before the application saw it."""
        super().data_received(data)
        if self.conn.handshake_exc is not None and not self.handshake_initiated and not self.transport.is_closing():
            causes = (self.conn.handshake_exc, self.conn.handshake_exc.__cause__)
            is_long = any(isinstance(each, SecurityError) for each in causes)
            self.transport.write(_refusal(TOO_LONG if is_long else 400, TOO_LARGE if is_long else CANNOT_BE_READ))
            self.transport.close()


def _refusal(status: int, text: str) -> bytes:
    body = text.encode()
    headers = [
        ("content-type", "text/plain; charset=utf-8"),
        ("connection", "close"),
        ("content-length", str(len(body))),
    ]
    connection = h11.Connection(h11.SERVER)
    events = (h11.Response(status_code=status, headers=headers), h11.Data(data=body), h11.EndOfMessage())
    return b"".join(connection.send(event) or b"" for event in events)


SAY_AGAIN_S = 10.0
"""Minimum seconds between two log lines about refused connections."""
MOST_REFUSED = 64
"""Largest number of connections that one `accept` call closes before the event loop runs other work."""


class AddressBound:
    """Counter and limit of open connections per address (per /64 for IPv6). Thread-safe."""

    def __init__(
        self,
        most: int,
        exempt: Sequence[str] = (),
        on_refused: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Set the largest number of connections per address.

        Args:
            most: connections allowed per address; 0 means no limit.
            exempt: networks that are not counted, normally the trusted proxies. X-Forwarded-For is
                not considered, because connections are refused before anything is read.
            on_refused: called for each connection closed because its address is at the limit.
            clock: monotonic time in seconds.
        """
        self._most, self._on_refused, self._clock = most, on_refused, clock
        self._exempt = [ipaddress.ip_network(each) for each in exempt]
        self._open: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._said_s: float | None = None

    def enter(self, address: str) -> str | None:
        """Count a new connection of an address.

        Returns:
            The key to pass to `leave`, or None if the address is at its limit.
        """
        key = "" if not self._most or self._is_exempt(address) else network_of_address(address)
        with self._lock:
            if key and self._open[key] >= self._most:
                self._on_refused()
                self._say(key)
                return None
            self._open[key] += 1
            return key

    def leave(self, key: str) -> None:
        """Uncount a closed connection; `key` is the result of `enter`."""
        with self._lock:
            self._open[key] -= 1
            if self._open[key] <= 0:
                del self._open[key]

    def open(self, address: str) -> int:
        """Return the number of open connections of an address."""
        with self._lock:
            return self._open[network_of_address(address)]

    def _is_exempt(self, address: str) -> bool:
        try:
            ip = ipaddress.ip_address(address)
        except ValueError:
            return False
        ip = getattr(ip, "ipv4_mapped", None) or ip
        return any(ip in network for network in self._exempt if network.version == ip.version)

    def _say(self, key: str) -> None:
        now_s = self._clock()
        if self._said_s is None or now_s - self._said_s >= SAY_AGAIN_S:
            self._said_s = now_s
            log.warning(
                "%s has %d connections, which is limits.connections_per_address; more are closed", key, self._open[key]
            )


class BoundedListener(socket.socket):
    """Listening socket whose `accept` closes connections above the limit.

    asyncio accepts through this method, before TLS and before any request is read.
    """

    bound: AddressBound

    @classmethod
    def of(cls, listener: socket.socket, bound: AddressBound) -> BoundedListener:
        """Wrap an existing listening socket, taking over its descriptor."""
        made = cls(listener.family, listener.type, listener.proto, fileno=listener.detach())
        made.bound = bound
        return made

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept the next connection within the limit.

        Raises:
            BlockingIOError: if none is pending, or after `MOST_REFUSED` refused connections.
        """
        for _ in range(MOST_REFUSED):
            descriptor, address = self._accept()  # type: ignore[attr-defined]
            taken = _Connection(self.family, self.type, self.proto, fileno=descriptor)
            key = self.bound.enter(str(address[0]))
            if key is None:
                taken.close()
                continue
            taken.left = lambda key=key: self.bound.leave(key)
            return taken, address
        raise BlockingIOError("the connections that wait are beyond the bound; the loop comes back for the next")


class _Connection(socket.socket):
    """Accepted connection that calls `left` once when it is closed or detached."""

    left: Callable[[], None] | None = None

    def close(self) -> None:
        """Close the connection and call `left`."""
        super().close()
        left, self.left = self.left, None
        if left is not None:
            left()

    def detach(self) -> int:
        """Release the descriptor and call `left`."""
        left, self.left = self.left, None
        if left is not None:
            left()
        return super().detach()


SOCKET, WATCHDOG_US, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"


class ServiceManager:
    """Client of the systemd notification socket. The constructor removes systemd's variables from the environment,
    so that child processes cannot send notifications."""

    def __init__(self, environment: MutableMapping[str, str] | None = None) -> None:
        found = os.environ if environment is None else environment
        address, after_us, pid = (found.pop(name, "") for name in (SOCKET, WATCHDOG_US, WATCHDOG_PID))
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        meant = after_us.isdigit() and pid in ("", str(os.getpid()))
        self.feed_s = int(after_us) / 2e6 if meant and address else None
        """Interval of watchdog notifications in seconds, half of systemd's timeout. None if systemd requests no
        watchdog."""

    def tell(self, *lines: str) -> None:
        """Send `NAME=value` lines to systemd. Failures are logged and otherwise ignored."""
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.setblocking(False)  # never block the event loop
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            log.warning("systemd was not notified of %s: %s", lines[0], error)

    async def feed_watchdog(self) -> None:
        """Send watchdog notifications to systemd until cancelled. Return at once if the watchdog is off."""
        while self.feed_s is not None:
            self.tell("WATCHDOG=1")
            await asyncio.sleep(self.feed_s)


MOST_UNSENT_BYTES = 64 * 1024
"""Limit of unsent bytes that the kernel buffers per connection. A small limit prevents a queue of outdated pictures
for a slow viewer."""
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
    # uvicorn re-raises the signal for the previous handler after shutdown. A drained server must exit normally instead.
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
    """uvicorn server that notifies the application at once when it starts to drain, so that endless responses end."""

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

    The head must be complete within `head_s`; uvicorn itself sets no such limit. A head that is too long gets 431, another
    malformed request 400.

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
            """Answer a request that h11 refuses with the status that h11 suggests, and with its reason. If the answer to the
            request has begun, only close the connection."""
            self._stop_watching()
            if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
                error = sys.exception()
                is_long = isinstance(error, h11.RemoteProtocolError) and error.error_status_hint == TOO_LONG
                text = HEAD_TOO_LONG if is_long else f"the request cannot be parsed: {error or msg}"
                self.transport.write(_refusal(TOO_LONG if is_long else 400, text))
            self.transport.close()

        def _close(self) -> None:
            if self.conn.their_state is h11.IDLE and not self.transport.is_closing():
                self.transport.close()

    return HeadLimits


def bind(settings: ServiceSettings) -> socket.socket:
    """Bind the listening socket at the configured address.

    Raises:
        CannotServe: if the socket cannot be bound, or the address is reachable from the network without TLS.
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
    # Accepted connections inherit these options. asyncio disables Nagle's algorithm only for sockets with an explicit
    # protocol, which this one lacks. An answer's body would otherwise wait 40 ms for the acknowledgement of its head.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # The kernel would buffer up to 4 MB per slow viewer, which is seconds of outdated pictures.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MOST_UNSENT_BYTES)
    # The kernel drops a connection whose peer acknowledges nothing for this time.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(settings.limits.viewer_stall_s * 1000))
    return listener


def _refuse_plaintext(settings: ServiceSettings) -> None:
    server = settings.server
    if server.certfile is None and not server.plaintext and not is_loopback(server.host):
        raise CannotServe(
            f"server.host is {server.host}, which others reach, without TLS: keys would travel in the clear; give server.certfile and"
            " server.keyfile, or server.plaintext: true where something before this server does TLS"
        )


def _address(listener: socket.socket, settings: ServiceSettings) -> str:
    host, port = listener.getsockname()[:2]
    scheme = "http" if settings.server.certfile is None else "https"
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"


def _done(number: int, frame: FrameType | None) -> None:
    """Signal handler that does nothing: uvicorn has already handled the signal by draining."""


POLL_S = 2.0
"""Interval in seconds at which the certificate and key files are checked for changes."""
_CERTIFICATE = re.compile(r"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)
_SEQUENCE, _VERSION, _UTC_TIME = 0x30, 0xA0, 0x17


class ServerCertificate(Collector):
    """Certificate chain and key of a server, reloaded when the files change.

    New connections use the newest chain and key that loaded successfully. If new files fail to load, the error is
    logged, the previous chain and key stay in use, and /readyz reports degraded.
    """

    def __init__(self, certfile: Path, keyfile: Path, events: SystemEvents | None = None) -> None:
        """Load the certificate chain and its key.

        Raises:
            OSError: if loading fails (ssl.SSLError is a subclass).
        """
        self._certfile, self._keyfile = certfile, keyfile
        self._events = events or SystemEvents()
        self._stamp = self._stamp_now()
        self._context, self._expires_s = _loaded(certfile, keyfile)
        self._failure: str | None = None

    @property
    def expires_at(self) -> datetime:
        """Earliest expiry among the certificates of the chain."""
        return datetime.fromtimestamp(self._expires_s, UTC)

    def attach(self, context: ssl.SSLContext) -> None:
        """Make new connections of a listening TLS context use the newest chain and key."""

        def choose(connection: ssl.SSLObject | ssl.SSLSocket, name: str | None, _: ssl.SSLContext) -> None:
            connection.context = self._context

        # OpenSSL calls this for each handshake, with or without a server name.
        context.sni_callback = choose

    def reload_if_changed(self) -> bool:
        """Reload chain and key if their files changed.

        Returns:
            True if a new chain and key are in use.
        """
        stamp = self._stamp_now()
        if stamp == self._stamp:
            return False
        self._stamp = stamp
        try:
            self._context, self._expires_s = _loaded(self._certfile, self._keyfile)
        except OSError as error:
            self._failure = f"{error.strerror or error}"
            log.error(
                "%s and %s were changed and cannot be used: %s; the certificate before stays in use until they are mended",
                self._certfile, self._keyfile, self._failure,
            )  # fmt: skip
            return False
        self._failure = None
        log.info("the certificate was loaded again; it expires at %s", self.expires_at.isoformat())
        return True

    @asynccontextmanager
    async def watched(self) -> AsyncIterator[None]:
        """Check the files for changes periodically while the block runs."""
        looking = asyncio.create_task(self._watch(), name="changes of the certificate")
        try:
            yield
        finally:
            looking.cancel()
            await asyncio.gather(looking, return_exceptions=True)

    async def check(self) -> CheckResult:
        """Report the expiry for /readyz; degraded if expired or if newer files cannot be used."""
        left_s = self._expires_s - time.time()
        when = f"{self.expires_at:%Y-%m-%d %H:%M} UTC"
        said = f"it expires at {when}, in {left_s / 86400:.0f} days" if left_s > 0 else f"it has expired at {when}"
        if self._failure is not None:
            return CheckResult(
                False, f"the new files cannot be used: {self._failure}; of the one in use: {said}", False
            )
        return CheckResult(left_s > 0, said if left_s > 0 else f"{said}; renew it", False)

    def collect(self) -> Iterable[Metric]:
        """Export metrics of the TLS certificate: expiry time and reload status."""
        expiry = GaugeMetricFamily(
            "intrasplat_certificate_expiry_timestamp_seconds", "Unix time at which the TLS certificate in use expires."
        )
        expiry.add_metric([], self._expires_s)
        failed = GaugeMetricFamily(
            "intrasplat_certificate_reload_failed", "1 while the certificate's files cannot be used as they are now."
        )
        failed.add_metric([], float(self._failure is not None))
        return [expiry, failed]

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(POLL_S)
            failed_before = self._failure
            changed = await asyncio.to_thread(self.reload_if_changed)
            if changed:
                self._events.tell("certificate.reload", "server", expires_at=self.expires_at.isoformat())
            elif self._failure is not None and self._failure != failed_before:
                self._events.tell("certificate.reload", "server", "failed")

    def _stamp_now(self) -> tuple[object, ...]:
        """Return a fingerprint of the files: device, inode, mtime and size, or the error number of a file that cannot
        be read. Symbolic links, as Kubernetes mounts them, are followed."""
        found: list[object] = []
        for file in (self._certfile, self._keyfile):
            try:
                status = os.stat(file)
                found.append((status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size))
            except OSError as error:
                found.append(error.errno)
        return tuple(found)


def _loaded(certfile: Path, keyfile: Path) -> tuple[ssl.SSLContext, float]:
    """Load a chain and its key.

    Returns:
        A TLS context, and the earliest expiry in the chain as Unix time.

    Raises:
        OSError: if a file is missing or cannot be used.
    """
    for file in (certfile, keyfile):
        if not file.exists():
            raise FileNotFoundError(2, f"{file}: No such file or directory")
        if not file.is_file():  # opening a pipe would block
            raise OSError(22, f"{file} is not a file")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certfile, keyfile, password="")  # refuse a key with a passphrase instead of prompting
    try:
        text = certfile.read_text(encoding="ascii", errors="replace")
        expiries = [expiry_of(ssl.PEM_cert_to_DER_cert(each)) for each in _CERTIFICATE.findall(text)]
        return context, min(expiries)
    except (ValueError, IndexError) as error:
        raise OSError(22, f"{certfile}: the expiry of its certificates cannot be read") from error


def expiry_of(der: bytes) -> float:
    """Return the end of a certificate's validity as Unix time (RFC 5280, 4.1).

    Args:
        der: a certificate in DER encoding.

    Raises:
        ValueError: if the data is not a certificate.
        IndexError: if the data is truncated.
    """
    certificate = _content(der, 0, _SEQUENCE)[0]
    fields = _content(der, certificate, _SEQUENCE)[0]
    if der[fields] == _VERSION:
        fields = _content(der, fields, _VERSION)[1]
    for _ in range(3):  # skip serial number, signature algorithm, issuer
        fields = _content(der, fields)[1]
    validity = _content(der, fields, _SEQUENCE)[0]
    at = _content(der, validity)[1]  # skip notBefore
    start, end = _content(der, at)
    text = der[start:end].decode("ascii")
    form = "%y%m%d%H%M%SZ" if der[at] == _UTC_TIME else "%Y%m%d%H%M%SZ"
    time_ = datetime.strptime(text, form)
    if der[at] == _UTC_TIME and time_.year >= 2050:  # RFC 5280: two-digit years from 50 mean 1950 to 1999
        time_ = time_.replace(year=time_.year - 100)
    return time_.replace(tzinfo=UTC).timestamp()


def _content(der: bytes, at: int, tag: int | None = None) -> tuple[int, int]:
    """Return the start and end offset of the content of the DER value at `at`.

    Raises:
        ValueError: if the value has another tag than `tag`.
    """
    if tag is not None and der[at] != tag:
        raise ValueError(f"tag {der[at]:#x} in place of {tag:#x}")
    length, start = der[at + 1], at + 2
    if length & 0x80:
        size = length & 0x7F
        length, start = int.from_bytes(der[start : start + size], "big"), start + size
    return start, start + length
