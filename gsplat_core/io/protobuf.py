"""Reading of protobuf messages without their schema."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
"""Wire types."""


def fields(message: memoryview) -> Iterator[tuple[int, int | bytes | memoryview]]:
    """Yield number and value of a message's fields, in order.

    Values are integers, `bytes` for fields of 4 and 8 bytes, and a `memoryview` for length-delimited fields.

    Raises:
        ValueError: for bytes that are not a protobuf message.
    """
    at = 0
    while at < len(message):
        tag, at = varint(message, at)
        field, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            number, at = varint(message, at)
            yield field, number
            continue
        if wire == _BYTES:
            length, at = varint(message, at)
        elif wire in (_FIXED64, _FIXED32):
            length = 8 if wire == _FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire}")
        if field == 0 or at + length > len(message):
            raise ValueError("it ends too early")
        value = message[at : at + length]
        yield field, value if wire == _BYTES else bytes(value)
        at += length


def values(message: memoryview, *path: int) -> list[Any]:
    """Return the values of all fields at a path of field numbers, of which all but the last are messages.

    Raises:
        ValueError: for bytes that are not a protobuf message.
    """
    found: list[Any] = [message]
    for number in path:
        found = [value for each in found for field, value in fields(each) if field == number]
    return found


def varint(message: memoryview, at: int) -> tuple[int, int]:
    """Return the integer of variable length at position `at`, and the position after it.

    Raises:
        ValueError: if it does not end, or has more than 64 bits.
    """
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            raise ValueError("it ends too early")
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number of more than 64 bits")
