"""Safe reading of ONNX files without the onnx package: bounded in size and self-contained.

A model can store weights in other files named by path. Loading them would let a foreign model read
any file of the machine, so such models are rejected and the runtime gets bytes instead of a path.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import read_regular

MOST_BYTES = 512 * 2**20
MOST_NESTING = 64
_EXTERNAL_DATA, _DATA_LOCATION, _EXTERNAL = 13, 14, 1
"""Field numbers of a tensor in onnx.proto, and the value of the second field that marks external
data.
"""
_PARTS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
"""Fields of each message type that lead to tensors (onnx.proto, IR version 13)."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
"""Protobuf wire types."""


def read_model(path: Path, what: str) -> bytes:
    """Read an ONNX file.

    Args:
        path: the file.
        what: description of the model for error messages, such as "tool network".

    Raises:
        InvalidSetting: for an unreadable or invalid file, one that is too large, or one with
            external data.
    """
    try:
        data = read_regular(path, MOST_BYTES)
    except OSError as error:
        raise InvalidSetting(f"{what} {path} cannot be read ({error.strerror or error}); give an ONNX file") from error
    try:
        external = has_external_data(data)
    except ValueError as error:
        raise InvalidSetting(f"{what} {path} is no ONNX model ({error}); export it again") from error
    if external:
        raise InvalidSetting(
            f"{what} {path} keeps data in other files, which are not opened;"
            " export it as one file (torch.onnx.export(..., external_data=False))"
        )
    return data


def has_external_data(data: bytes) -> bool:
    """Return True if a tensor of a model has external data.

    Raises:
        ValueError: for bytes that are not a protobuf message.
    """
    waiting: list[tuple[str, memoryview, int]] = [("model", memoryview(data), 0)]
    while waiting:
        kind, message, depth = waiting.pop()
        if depth > MOST_NESTING:
            raise ValueError(f"graphs inside each other more than {MOST_NESTING} deep")
        for field, value in _fields(message):
            if kind == "tensor":
                if field == _EXTERNAL_DATA or (field == _DATA_LOCATION and value == _EXTERNAL):
                    return True
            elif field in _PARTS[kind] and isinstance(value, memoryview):
                waiting.append((_PARTS[kind][field], value, depth + 1))
    return False


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield number and value of a message's fields: integers, and bytes of length-delimited fields."""
    at = 0
    while at < len(message):
        tag, at = _varint(message, at)
        field, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            number, at = _varint(message, at)
            yield field, number
            continue
        if wire == _BYTES:
            length, at = _varint(message, at)
        elif wire in (_FIXED64, _FIXED32):
            length = 8 if wire == _FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire}")
        if field == 0 or at + length > len(message):
            raise ValueError("it ends too early")
        if wire == _BYTES:
            yield field, message[at : at + length]
        at += length


def _varint(message: memoryview, at: int) -> tuple[int, int]:
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
