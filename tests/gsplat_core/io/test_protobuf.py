"""Messages are read without their schema, and never beyond their end."""

from __future__ import annotations

import struct

import pytest

from gsplat_core.endoscope.onnx import fields, values, varint

NESTED = b"\x0a\x02hi" + b"\x12\x04" + b"\x08\x07\x08\x08" + b"\x12\x02" + b"\x08\x09"
"""Text in field 1, and two messages in field 2 with the numbers 7, 8 and 9 in their field 1."""


def test_varint_has_at_most_ten_bytes():
    """Seven bits each, the lowest first. A length of eleven would be read from foreign bytes."""
    assert varint(memoryview(b"\x07"), 0) == (7, 1)
    assert varint(memoryview(b"x\x96\x01y"), 1) == (150, 3)
    assert varint(memoryview(9 * b"\x80" + b"\x01"), 0) == (2**63, 10)
    with pytest.raises(ValueError, match="more than 64 bits"):
        varint(memoryview(10 * b"\x80" + b"\x01"), 0)
    with pytest.raises(ValueError, match="ends too early"):
        varint(memoryview(b"\x80"), 0)


def test_protobuf_wire_types_give_value_types():
    number, half, whole = b"\x08\x96\x01", b"\x15" + struct.pack("<f", 0.5), b"\x19" + struct.pack("<d", 0.25)
    read = list(fields(memoryview(number + half + whole + b"\x22\x02hi")))
    assert [field for field, _ in read] == [1, 2, 3, 4]
    assert read[0][1] == 150
    assert struct.unpack("<f", read[1][1]) == (0.5,) and type(read[1][1]) is bytes
    assert struct.unpack("<d", read[2][1]) == (0.25,) and type(read[2][1]) is bytes
    assert read[3][1] == b"hi" and type(read[3][1]) is memoryview


def test_protobuf_values_by_path():
    message = memoryview(NESTED)
    assert values(message, 1) == [b"hi"]
    assert values(message, 2, 1) == [7, 8, 9]
    assert values(message, 3) == values(message, 3, 1) == []


@pytest.mark.parametrize(
    "data", [b"\x09" + bytes(7), b"\x0d" + bytes(3), b"\x0a\x03ab", b"\x00\x01\x02\x80", b"\x02\x01a"]
)
def test_truncated_protobuf_message_is_refused(data):
    with pytest.raises(ValueError, match="ends too early"):
        list(fields(memoryview(data)))


def test_protobuf_groups_are_refused():
    with pytest.raises(ValueError, match="wire type 3"):
        list(fields(memoryview(b"\x0b")))
