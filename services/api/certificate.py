"""The server's TLS certificate: reloaded when its files change, with its expiry in /readyz and in the metrics."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import ssl
import time
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from pathlib import Path

from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from services.audit.log import SystemEvents
from services.schemas import CheckResult

log = logging.getLogger(__name__)
LOOK_S = 2.0
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

    def look(self) -> bool:
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
        """Export the expiry time and the reload status; see `Collector`."""
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
            await asyncio.sleep(LOOK_S)
            failed_before = self._failure
            changed = await asyncio.to_thread(self.look)
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
