"""Stream pictures over a WebSocket."""

from __future__ import annotations

import json
import ssl
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode, urlsplit

from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

from gsplat_core.io.files import read_regular
from services.errors import ClientError, Unreachable

MOST_CERTIFICATE_BYTES = 1 << 20
MOST_BYTES = 64 << 20


@dataclass(frozen=True)
class Picture:
    """Received picture."""

    header: dict[str, Any]
    """Sequence number, timestamps, age and state (docs/design/processes.md)."""
    jpeg: bytes


def pictures(url: str, path: str, ticket: str, kind: str, quality: int, verify: bool | str) -> Iterator[Picture]:
    """Yield pictures until the server closes the connection.

    Raises:
        Unreachable: if the connection fails.
    """
    parts = urlsplit(url)
    query = urlencode({"kind": kind, "quality": quality, "ticket": ticket})
    scheme = "wss" if parts.scheme == "https" else "ws"
    try:
        with connect(
            f"{scheme}://{parts.netloc}{path}?{query}",
            max_size=MOST_BYTES,
            ssl=tls_context(verify) if scheme == "wss" else None,
        ) as socket:
            for message in socket:
                if isinstance(message, bytes):
                    yield picture_of(message)
    except ConnectionClosed:
        return
    except (OSError, InvalidHandshake, TimeoutError) as error:
        raise Unreachable(f"{url} shows no pictures of this stream: {error}") from error


def picture_of(message: bytes) -> Picture:
    """Parse a message: header length (4 bytes, big-endian), JSON header, JPEG."""
    (length,) = struct.unpack_from(">I", message)
    return Picture(json.loads(message[4 : 4 + length]), message[4 + length :])


def tls_context(verify: bool | str) -> ssl.SSLContext:
    """Return the TLS context: system authorities (True), a CA file (path) or no check (False).

    Raises:
        ClientError: if the file is unusable.
    """
    authority = None
    if isinstance(verify, str):
        try:
            authority = read_regular(verify, MOST_CERTIFICATE_BYTES).decode("ascii")
        except OSError as error:
            raise ClientError(f"the certificate {verify} cannot be read: {error.strerror or error}") from error
        except UnicodeDecodeError as error:
            raise ClientError(f"{verify} is no certificate: it must be PEM, which is ASCII text") from error
    try:
        context = ssl.create_default_context(cadata=authority)
    except (ssl.SSLError, ValueError) as error:
        raise ClientError(f"{verify} is no certificate: {error}; give one in PEM") from error
    if verify is False:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    return context
