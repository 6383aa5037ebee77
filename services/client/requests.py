"""Requests to a server: with one key, errors as sentences."""

from __future__ import annotations

import base64
import hashlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import httpx2

from gsplat_core.io.atomic_files import PartialFile
from services.client.errors import ClientError, Refused, Unreachable
from services.client.pictures import tls_context

CHUNK_BYTES = 1 << 20
Found = TypeVar("Found")


class Requests:
    """What all methods of a client go through."""

    def __init__(self, url: str, key: str, timeout_s: float, verify: bool | str) -> None:
        self.url = url.rstrip("/")
        self._key = key.strip()
        self._verify = verify
        self._http = httpx2.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {self._key}"},
            timeout=timeout_s,
            verify=tls_context(verify),
        )

    def _ask(self, method: str, path: str, **options: Any) -> Any:
        """The JSON of the answer, None where it has none. Raises Unreachable, Refused."""
        answer = self._answer(method, path, **options)
        return answer.json() if answer.content else None

    def _answer(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """An answer that is a success. Raises Unreachable, Refused."""
        try:
            answer = self._http.request(method, path, **options)
        except httpx2.HTTPError as error:
            raise self._unreachable(error) from error
        if answer.is_success:
            return answer
        raise refused_by(answer, self.url)

    def _put_file(self, path: str, file: Path) -> Any:
        """Send a file as the body, with its digest. Raises ClientError for one that cannot be read."""
        try:
            digest, size = _digest_of(file)
            with file.open("rb") as content:
                headers = {
                    "Content-Type": "application/octet-stream",
                    "Content-Length": str(size),
                    "Content-Digest": f"sha-256=:{digest}:",
                }
                return self._ask("PUT", path, content=iter(lambda: content.read(CHUNK_BYTES), b""), headers=headers)
        except OSError as error:
            raise ClientError(f"{file} cannot be read: {error.strerror or error}") from error

    def _get_file(self, path: str, file: Path) -> None:
        """Write the body of an answer into a file, which is whole or not there. Raises ClientError where it cannot be written."""
        try:
            with PartialFile(file) as partial, self._http.stream("GET", path) as answer:
                if not answer.is_success:
                    answer.read()
                    raise refused_by(answer, self.url)
                for chunk in answer.iter_bytes(CHUNK_BYTES):
                    partial.file.write(chunk)
        except httpx2.HTTPError as error:
            raise self._unreachable(error) from error
        except OSError as error:
            raise ClientError(f"{file} cannot be written: {error.strerror or error}") from error

    def _unreachable(self, error: Exception) -> Unreachable:
        said = error or type(error).__name__
        return Unreachable(f"{self.url} does not answer: {said}; check the address, and that the server runs")


def waited_for(ask: Callable[[], Found], is_over: Callable[[Found], bool], within_s: float, what: str) -> Found:
    """Ask again and again, less and less often, until it is over. Raises ClientError when that takes too long."""
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
    """What a server said that said no; its answer was read."""
    try:
        said = answer.json()
        sentence = str(said.get("detail") or said.get("title"))
    except (ValueError, AttributeError):
        sentence = f"an answer that is no problem document; is {url} an IntraSplat server?"
    return Refused(answer.status_code, sentence)


def _digest_of(file: Path) -> tuple[str, int]:
    """SHA-256 in base64, and the size."""
    with file.open("rb") as content:
        digest = hashlib.file_digest(content, "sha256").digest()
        return base64.b64encode(digest).decode(), content.tell()
