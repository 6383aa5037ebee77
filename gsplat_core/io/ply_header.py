"""Header of `.ply` files with Gaussians: the elements `vertex`, or `chunk`, `vertex` and `sh` of the compressed layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsplat_core.errors import BundleCorrupt

MAX_HEADER_BYTES = 1 << 16
MARK_LINE = "comment written by IntraSplat"
"""Header line that identifies a file written by this program."""
SCALAR_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
FOLLOWING = {None: ("vertex", "chunk"), "chunk": ("vertex",), "vertex": ("sh",)}
"""Names of the elements that may follow an element; None stands for the start of the file."""


@dataclass(frozen=True)
class Element:
    """Element of a `.ply` file: rows of scalar properties."""

    name: str
    count: int
    layout: np.dtype[np.void]
    """Structured dtype of one row, with the property names."""

    @property
    def nbytes(self) -> int:
        """Size of all rows in bytes."""
        return self.count * self.layout.itemsize

    @property
    def names(self) -> tuple[str, ...]:
        """Property names in the order of the file."""
        return self.layout.names or ()


def header_lines(elements: list[tuple[str, int, list[str]]]) -> list[str]:
    """Return the lines of a PLY file's header.

    Args:
        elements: name, number of rows, and properties such as `float x` of each element.
    """
    lines = ["ply", "format binary_little_endian 1.0", MARK_LINE]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {each}" for each in properties)]
    return [*lines, "end_header", ""]


def read_header(file: BinaryIO, path: Path) -> list[Element]:
    """Parse the header and leave the file at the first row.

    Returns:
        One element (`vertex`), or two to three (`chunk`, `vertex`, `sh`). Further elements are not read.

    Raises:
        BundleCorrupt: if the header is malformed or has no such elements.
    """
    lines = _lines(file, path)
    if lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise BundleCorrupt(
            f"{path}: expected 'ply' and 'format binary_little_endian 1.0', got {[line[:80] for line in lines[:2]]}"
        )
    found: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines[2:]:
        last = found[-1][0] if found else None
        match line.split():
            case ["comment" | "obj_info", *_]:
                continue
            case ["element", name, number] if (
                name in FOLLOWING.get(last, ()) and number.isdecimal() and len(number) < 12
            ):
                if name == "sh" and found[0][0] != "chunk":
                    break
                found.append((name, int(number), []))
            case ["element", _, _] if last in ("vertex", "sh"):
                break
            case ["property", kind, name] if found and kind in SCALAR_TYPES:
                found[-1][2].append((name, SCALAR_TYPES[kind]))
            case _:
                raise BundleCorrupt(f"{path}: unexpected line in the header: {line[:80]!r}; vertices must come first")
    if not found or found[-1][0] == "chunk":
        raise BundleCorrupt(f"{path}: the header has no vertices; it is not a file of Gaussians")
    for name, _, properties in found:
        names = [each for each, _ in properties]
        if not names or len(set(names)) != len(names):
            raise BundleCorrupt(
                f"{path}: the element {name} has no properties or a property twice: {names[:80]}; export the file again"
            )
    return [Element(name, count, np.dtype(properties)) for name, count, properties in found]


def _lines(file: BinaryIO, path: Path) -> list[str]:
    lines: list[str] = []
    read = 0
    while not lines or lines[-1] != "end_header":
        line = file.readline(MAX_HEADER_BYTES - read + 1)
        read += len(line)
        if not line.endswith(b"\n") or read > MAX_HEADER_BYTES:
            raise BundleCorrupt(
                f"{path}: no 'end_header' in the first {min(read, MAX_HEADER_BYTES)} bytes; it is not a ply file"
            )
        try:
            lines.append(line.decode("ascii").strip())
        except UnicodeDecodeError as error:
            raise BundleCorrupt(f"{path}: the header holds bytes that are not ASCII: {line[:40]!r}") from error
    return lines[:-1]
