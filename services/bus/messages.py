"""JSON messages of the bus: one object of limited size. Nothing is ever unpickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from services.bus.errors import BadMessage

MOST_BYTES = 1 << 16
"""Largest message in bytes."""


def packed_json(content: Mapping[str, Any]) -> bytes:
    """Encode an object.

    Raises:
        BadMessage: if it is too large or not representable in JSON.
    """
    try:
        data = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
    except (TypeError, ValueError) as error:
        raise BadMessage(f"this cannot be sent as JSON: {error}") from None
    if len(data) > MOST_BYTES:
        raise BadMessage(f"a message of {len(data)} bytes is not sent; at most {MOST_BYTES} are")
    return data


def parsed_json(data: bytes | memoryview) -> dict[str, Any]:
    """Decode an object.

    Raises:
        BadMessage: if the data is too large or is no JSON object.
    """
    if len(data) > MOST_BYTES:
        raise BadMessage(f"a message of {len(data)} bytes is not read; at most {MOST_BYTES} are")
    text = bytes(data)
    try:
        content = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise BadMessage(f"{text[:40]!r} is not JSON: {error}") from None
    if not isinstance(content, dict):
        raise BadMessage(f"{text[:40]!r} is not a JSON object")
    return content


def _refuse(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")
