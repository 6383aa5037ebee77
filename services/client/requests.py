"""HTTP requests of the client, with the API key and readable errors, and stream pictures over a WebSocket."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import ssl
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar
from urllib.parse import urlencode, urlsplit

import httpx2
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

from gsplat_core.io.files import PartialFile, open_regular, read_regular
from services.errors import ClientError, Refused, Unreachable

MOST_CERTIFICATE_BYTES = 1 << 20
MOST_BYTES = 64 << 20


@dataclass(frozen=True)
class Picture:
    """Picture of a stream that the client received, as JPEG with its header."""

    header: dict[str, Any]
    """Entries for sequence number, timestamps, age and state of the picture (docs/design/processes.md)."""
    jpeg: bytes


def pictures(url: str, path: str, ticket: str, kind: str, quality: int, verify: bool | str) -> Iterator[Picture]:
    """Yield pictures until the server closes the connection.

    Raises:
        Unreachable: if the connection fails.
        ClientError: if the CA file `verify` is unusable.
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


CHUNK_BYTES = 1 << 20
MOST_ANSWER_BYTES = 64 << 20
MOST_PROBLEM_BYTES = 1 << 16
MOST_KEY_CHARACTERS = 4096
SLOWEST = 10
"""Multiple of the read timeout after which an unfinished answer is abandoned."""
Found = TypeVar("Found")


class Requests:
    """Base class of the client with the request methods."""

    def __init__(self, url: str, key: str, timeout_s: float, verify: bool | str) -> None:
        """Open the HTTP client.

        Raises:
            ClientError: if the address, the key or the certificate is unusable.
        """
        self.url = checked_url(url)
        self._key = checked_key(key)
        self._verify = verify
        self._timeout_s = timeout_s
        self._http = httpx2.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {self._key}"},
            timeout=timeout_s,
            # Loading the system's authorities takes longer than a plain HTTP request, which does not need them.
            verify=tls_context(verify) if self.url.startswith("https:") or isinstance(verify, str) else False,
        )

    def _ask(self, method: str, path: str, **options: Any) -> Any:
        """Send a request and return the JSON of the answer, or None for an empty answer.

        Raises:
            Unreachable: if the server does not answer.
            Refused: if the server refuses.
            ClientError: if the answer is no JSON.
        """
        answer = self._answer(method, path, **options)
        try:
            return answer.json() if answer.content else None
        except (ValueError, RecursionError) as error:
            raise not_from_us(self.url, "is no JSON") from error

    def _answer(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """Send a request and return the successful answer.

        Raises:
            Unreachable: if the server does not answer.
            Refused: if the server refuses.
            ClientError: if the answer is too large or too slow.
        """
        try:
            with self._http.stream(method, checked_path(path), **options) as answer:
                content = bytearray()
                until_s = time.monotonic() + SLOWEST * self._timeout_s
                for piece in answer.iter_bytes(CHUNK_BYTES):
                    content += piece
                    if len(content) > MOST_ANSWER_BYTES:
                        raise not_from_us(self.url, f"has more than {MOST_ANSWER_BYTES >> 20} MiB")
                    if time.monotonic() > until_s:
                        raise not_from_us(self.url, "does not end")
        except httpx2.HTTPError as error:
            raise self._unreachable(error) from error
        except (httpx2.InvalidURL, ValueError) as error:
            raise ClientError(f"the request cannot be sent: {error}; check the names and values in it") from error
        whole = _with_body(answer, content)
        if not whole.is_success:
            raise refused_by(whole, self.url)
        check_origin(answer, self.url)
        return whole

    def _put_file(self, path: str, file: Path, **options: Any) -> Any:
        """Send a file as the body, with its digest.

        Raises:
            ClientError: if the file cannot be read.
        """
        try:
            with open_regular(file) as content:
                digest, size = _digest_of(content)
                content.seek(0)
                headers = {
                    "Content-Type": "application/octet-stream",
                    "Content-Length": str(size),
                    "Content-Digest": f"sha-256=:{digest}:",
                }
                return self._ask("PUT", path, content=_pieces(content, size, file), headers=headers, **options)
        except OSError as error:
            raise ClientError(f"{file} cannot be read: {error.strerror or error}") from error

    def _get_file(self, path: str, file: Path, *, overwrite: bool = False, method: str = "GET", **options: Any) -> int:
        """Download an answer's body to a file, atomically, verifying the stated length and digest.

        Returns:
            Size of the file in bytes.

        Raises:
            ClientError: if the verification fails, the file cannot be written, or it exists and `overwrite` is False.
        """
        if os.path.lexists(file) and not overwrite:
            raise ClientError(f"{file} already exists; give another name, or --overwrite to replace it")
        try:
            with (
                PartialFile(file, overwrite=overwrite) as partial,
                self._http.stream(method, checked_path(path), **options) as answer,
            ):
                if not answer.is_success:
                    raise refused_by(_with_body(answer, _read_some(answer)), self.url)
                check_origin(answer, self.url)
                sha256 = hashlib.sha256()
                for piece in answer.iter_bytes(CHUNK_BYTES):
                    partial.file.write(piece)
                    sha256.update(piece)
                _check_whole(answer, sha256.digest(), partial.file.tell(), file.name)
                return partial.file.tell()
        except httpx2.HTTPError as error:
            raise self._unreachable(error) from error
        except FileExistsError as error:
            raise ClientError(f"{file} already exists; give another name, or --overwrite to replace it") from error
        except OSError as error:
            raise ClientError(f"{file} cannot be written: {error.strerror or error}") from error
        except (httpx2.InvalidURL, ValueError) as error:
            raise ClientError(f"the request cannot be sent: {error}; check the names and values in it") from error

    def _unreachable(self, error: Exception) -> Unreachable:
        said = error or type(error).__name__
        return Unreachable(f"{self.url} does not answer: {said}; check the address, and that the server runs")


def checked_url(url: str) -> str:
    """Return a server address without trailing slash.

    Raises:
        ClientError: if the address is not valid.
    """
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0 and url.isprintable()
        if usable and not parts.query and not parts.fragment and " " not in url:
            httpx2.URL(url)
            return url.rstrip("/")
    except (ValueError, httpx2.InvalidURL) as error:
        raise ClientError(
            f"{url!r:.200} is no address of a server ({error}); give one such as https://room-1.example:8000"
        ) from error
    raise ClientError(f"{url!r:.200} is no address of a server; give one such as https://room-1.example:8000")


def checked_path(path: str) -> str:
    """Return a path of the API. Raises ClientError if a name in it would address something else, such as `../keys`."""
    for segment in path.split("/")[1:]:
        if segment in (".", "..") or set(segment) & set("?#%\\"):
            raise ClientError(f"the request {path!r:.200} has a name that the service cannot have: {segment!r:.60}")
    return path


def checked_key(key: str) -> str:
    """Return a key without surrounding whitespace.

    Raises:
        ClientError: if the text cannot be a key.
    """
    key = key.strip()
    if not key:
        raise ClientError("the API key is empty; give the one that `intrasplat keys add` printed")
    if not key.isascii() or not key.isprintable() or " " in key or len(key) > MOST_KEY_CHARACTERS:
        raise ClientError(
            "the API key has characters that no key has; give the one line that `intrasplat keys add` printed"
        )
    return key


def not_from_us(url: str, what: str) -> ClientError:
    """Return the error for an answer that is not from an IntraSplat server."""
    return ClientError(f"the answer of {url} {what}; is it an IntraSplat server?")


def _with_body(answer: httpx2.Response, content: bytes | bytearray) -> httpx2.Response:
    """Return a copy of an answer with its decoded body."""
    return httpx2.Response(answer.status_code, content=bytes(content))


def _read_some(answer: httpx2.Response) -> bytes:
    """Read the body of a refusal, up to the size limit of a problem document."""
    content = bytearray()
    for piece in answer.iter_bytes(1 << 16):
        content += piece
        if len(content) > MOST_PROBLEM_BYTES:
            break
    return bytes(content[:MOST_PROBLEM_BYTES])


def check_origin(answer: httpx2.Response, url: str) -> None:
    """Check that a successful answer is from an IntraSplat server, which numbers all its answers, and not a page of a proxy
    that wants a sign-in, for example.

    Raises:
        ClientError: if the answer has no request id.
    """
    if "x-request-id" not in answer.headers:
        raise not_from_us(url, "has no X-Request-ID")


def _check_whole(answer: httpx2.Response, digest: bytes, size: int, name: str) -> None:
    stated = answer.headers.get("content-digest")
    if stated is not None and stated != f"sha-256=:{base64.b64encode(digest).decode()}:":
        raise ClientError(f"{name} is not what the server's digest says; fetch it again")
    length = answer.headers.get("content-length")
    if length is None and stated is None:
        raise ClientError(f"the server says neither the length nor the digest of {name}; is it an IntraSplat server?")
    if length is not None and "content-encoding" not in answer.headers and length != str(size):
        raise ClientError(f"{name} has {size} bytes, and the server announced {length}; fetch it again")


def _pieces(content: BinaryIO, size: int, file: Path) -> Iterator[bytes]:
    """Yield the `size` bytes of a file for an upload, as announced in its Content-Length.

    Raises:
        ClientError: if the file becomes shorter or longer meanwhile.
    """
    left = size
    while piece := content.read(min(CHUNK_BYTES, left)):
        left -= len(piece)
        yield piece
    if left or content.read(1):
        raise ClientError(f"{file} changed while it was sent; try again")


def waited_for(ask: Callable[[], Found], is_over: Callable[[Found], bool], within_s: float, what: str) -> Found:
    """Poll with increasing intervals until `is_over` returns True.

    Raises:
        ClientError: after `within_s` seconds.
    """
    until_s, wait_s = time.monotonic() + within_s, 0.1
    while True:
        found = ask()
        if is_over(found):
            return found
        if time.monotonic() > until_s:
            raise ClientError(f"{what} is not finished after {within_s:g} s; ask again later")
        time.sleep(wait_s)
        wait_s = min(2 * wait_s, 2.0)


def refused_by(answer: httpx2.Response, url: str) -> Refused:
    """Build the error for a refusal from its problem document."""
    try:
        said = answer.json()
        sentence = str(said.get("detail") or said.get("title"))
    except (ValueError, AttributeError, RecursionError):
        sentence = f"an answer that is no problem document; is {url} an IntraSplat server?"
    return Refused(answer.status_code, sentence)


def _digest_of(content: BinaryIO) -> tuple[str, int]:
    """Return the SHA-256 in base64, and the size."""
    digest = hashlib.sha256()
    while piece := content.read(CHUNK_BYTES):
        digest.update(piece)
    return base64.b64encode(digest.digest()).decode(), content.tell()
