"""Backward reading of a file's lines, tolerating an incomplete last line after a crash."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from gsplat_core.io.files import open_regular

BLOCK_BYTES = 1 << 16


def whole_lines_bytes(path: Path, size: int) -> int:
    """Return the number of bytes up to the end of the last complete line."""
    with open_regular(path) as file:
        end = size
        while end:
            start = max(0, end - BLOCK_BYTES)
            file.seek(start)
            found = file.read(end - start).rfind(b"\n")
            if found >= 0:
                return start + found + 1
            end = start
    return 0


def lines_backwards(path: Path, size: int | None = None) -> Iterator[bytes]:
    """Yield the complete lines of a file, last one first."""
    with open_regular(path) as file:
        end = whole_lines_bytes(path, os.fstat(file.fileno()).st_size) if size is None else size
        rest = b""
        while end:
            start = max(0, end - BLOCK_BYTES)
            file.seek(start)
            block = file.read(end - start) + rest
            first, *lines = block.split(b"\n")
            yield from (line for line in reversed(lines) if line)
            rest, end = first, start
        if rest:
            yield rest
