"""NumPy's `.npy` files from unknown hands: the header with bounds, and the data only when its shape is the expected one."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from gsplat_core.io.recordings.plain_files import UnreadableFile, open_plain

MAX_HEADER_BYTES = 4096
"""NumPy writes 128 bytes for a plain array."""
_NUMBER_KINDS = "fiu"
_HEADER_READERS = {(1, 0): (2, npy.read_array_header_1_0), (2, 0): (4, npy.read_array_header_2_0)}
# What NumPy's reading of a header as a Python literal can end in.
_HEADER_ERRORS = (ValueError, TypeError, SyntaxError, TokenError, RecursionError, MemoryError, OverflowError)


@dataclass(frozen=True)
class ArrayHeader:
    """What a `.npy` file announces."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran_order: bool

    @property
    def bytes(self) -> int:
        """Bytes of the data, in Python's integers: no shape overflows."""
        count = self.dtype.itemsize
        for length in self.shape:
            count *= length
        return count


def read_header(path: Path) -> ArrayHeader:
    """The header alone. Raises UnreadableFile for what is no complete plain array of numbers."""
    with open_plain(path) as stream:
        return _header(stream)


def read_array(path: Path, wrong: Callable[[ArrayHeader], str | None]) -> NDArray[np.generic]:
    """The array, once `wrong` has nothing against its header. Raises UnreadableFile; takes no memory before that."""
    with open_plain(path) as stream:
        header = _header(stream)
        if complaint := wrong(header):
            raise UnreadableFile(complaint)
        data = stream.read(header.bytes)
    array = np.frombuffer(data, header.dtype)
    return array.reshape(header.shape, order="F" if header.fortran_order else "C")


def _header(stream: BinaryIO) -> ArrayHeader:
    size = os.fstat(stream.fileno()).st_size
    head = stream.read(12)
    if head.startswith(b"PK"):
        raise UnreadableFile("it is not a plain NumPy array: it is a zip archive (.npz)")
    version = (head[6], head[7]) if len(head) == 12 else (0, 0)
    if not head.startswith(b"\x93NUMPY") or version not in _HEADER_READERS:
        raise UnreadableFile(f"it is not a plain NumPy array (it begins with {head[:8]!r})")
    width, read = _HEADER_READERS[version]
    length = int.from_bytes(head[8 : 8 + width], "little")
    if length > MAX_HEADER_BYTES:
        raise UnreadableFile(
            f"it is not a plain NumPy array: its header announces {length} bytes, more than the bound of {MAX_HEADER_BYTES}"
        )
    stream.seek(8)
    try:
        shape, fortran_order, dtype = read(stream, max_header_size=MAX_HEADER_BYTES)
    except _HEADER_ERRORS as error:
        raise UnreadableFile(
            f"it is not a plain NumPy array, its header cannot be read: {(str(error).splitlines() or ['damaged'])[0]:.200}"
        ) from error
    header = ArrayHeader(tuple(shape), dtype, fortran_order)
    if dtype.kind not in _NUMBER_KINDS or dtype.itemsize > 8 or any(length < 0 for length in header.shape):
        raise UnreadableFile(f"it holds {dtype!s:.60} {list(header.shape)!s:.80} in place of plain numbers")
    left = size - stream.tell()
    if left < header.bytes:
        raise UnreadableFile(f"it is not a plain NumPy array: its data takes {header.bytes} bytes, {left} are there")
    return header
