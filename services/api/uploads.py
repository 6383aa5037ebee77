"""Receipt of uploads. The body is written to a temporary file while its digest is computed, which must equal the
header's."""

from __future__ import annotations

import asyncio
import base64
import binascii
import errno
import hashlib
import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from starlette.requests import Request

from services.api.problems import BadRequest, NoSpace, Problem, TooManyRequests, Unavailable, Unprocessable
from services.api.state import SPARE_BYTES, ControlState
from services.errors import disk_advice

_MEMBER = re.compile(r"\s*(?P<name>[a-z0-9*_.-]+)=:(?P<value>[A-Za-z0-9+/=]*):\s*")


def stated_sha256(header: str | None) -> bytes:
    """Return the SHA-256 in a Content-Digest header, 32 bytes.

    Raises:
        BadRequest: if the header is absent, malformed, or does not have exactly one sha-256.
    """
    if header is None:
        raise BadRequest("send the file's digest as `Content-Digest: sha-256=:BASE64:`")
    digests: list[bytes] = []
    for member in header.split(","):
        match = _MEMBER.fullmatch(member)
        if match is None:
            raise BadRequest("Content-Digest cannot be read; write `sha-256=:BASE64:`")
        if match["name"] == "sha-256":
            try:
                digests.append(base64.b64decode(match["value"], validate=True))
            except binascii.Error as error:
                raise BadRequest("the sha-256 of Content-Digest is not base64") from error
    if len(digests) != 1 or len(digests[0]) != 32:
        raise BadRequest("Content-Digest must have one sha-256 of 32 bytes")
    return digests[0]


PART_BYTES = 1 << 20


@dataclass(frozen=True)
class IncomingFile:
    """Complete upload. The file is deleted when the receiving block ends, unless it was moved."""

    path: Path
    size_bytes: int
    sha256: str


@asynccontextmanager
async def incoming_file(request: Request, control: ControlState, expected_sha256: bytes) -> AsyncIterator[IncomingFile]:
    """Stream the request body to a temporary file.

    Args:
        request: the upload.
        control: state of the application.
        expected_sha256: digest that the caller announced, 32 bytes.

    Yields:
        The complete file.

    Raises:
        TooManyRequests: if too many uploads run, in total or for this key.
        NoSpace: if the disk is full.
        Unavailable: if the disk cannot be used for another reason.
        Unprocessable: if the digest differs or the body is empty.
    """
    if control.uploads.locked():
        raise TooManyRequests("as many uploads as may are running; wait for one to end", 5.0)
    key = request.scope["state"]["caller"].key_id
    if control.uploads_of[key] >= control.settings.limits.uploads_per_key:
        raise TooManyRequests("as many uploads of this key as may are running; wait for one to end", 5.0)
    async with control.uploads, _counted(control.uploads_of, key):
        folder = control.uploads_dir
        try:
            _check_space(folder, int(request.headers.get("content-length", 0)))
            descriptor, name = tempfile.mkstemp(prefix="upload-", dir=folder)
        except OSError as error:
            raise _unkept(error) from error
        path = Path(name)
        try:
            size, digest = await _write(request, descriptor, control)
            if digest != expected_sha256:
                raise Unprocessable(
                    f"the body's SHA-256 is {digest.hex()}, Content-Digest says {expected_sha256.hex()}; send it again"
                )
            if size == 0:
                raise Unprocessable("the body is empty; send the file")
            yield IncomingFile(path, size, digest.hex())
        finally:
            with suppress(FileNotFoundError):
                path.unlink()


@asynccontextmanager
async def _counted(counts: Counter[str], key: str) -> AsyncIterator[None]:
    counts[key] += 1
    try:
        yield
    finally:
        counts[key] -= 1
        if not counts[key]:
            del counts[key]


async def _write(request: Request, descriptor: int, control: ControlState) -> tuple[int, bytes]:
    running = hashlib.sha256()
    size = 0

    def put(part: bytes) -> None:
        running.update(part)
        file.write(part)

    with os.fdopen(descriptor, "wb") as file:
        try:
            waiting = bytearray()
            async for chunk in request.stream():
                waiting += chunk
                size += len(chunk)
                if len(waiting) >= PART_BYTES:
                    _check_space(control.uploads_dir, 0)
                    await asyncio.to_thread(put, bytes(waiting))
                    waiting.clear()
            await asyncio.to_thread(put, bytes(waiting))
            await asyncio.to_thread(file.flush)
            await asyncio.to_thread(os.fsync, file.fileno())
        except OSError as error:
            raise _unkept(error) from error
    control.measures.upload_bytes.inc(size)
    return size, running.digest()


def _unkept(error: OSError) -> Problem:
    kind = NoSpace if error.errno in (errno.ENOSPC, errno.EDQUOT) else Unavailable
    return kind(f"the upload cannot be kept: {error.strerror}; {disk_advice(error)}")


def _check_space(folder: Path, wanted_bytes: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < wanted_bytes + SPARE_BYTES:
        raise NoSpace(
            f"{free // 2**20} MiB are free and {SPARE_BYTES // 2**20} MiB must stay so; delete recordings, replays or versions that are not needed"
        )
