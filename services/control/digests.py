"""Parser for the Content-Digest header (RFC 9530)."""

from __future__ import annotations

import base64
import binascii
import re

from services.control.problems import BadRequest

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
