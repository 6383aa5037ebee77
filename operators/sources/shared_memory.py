"""Frames in memory that two processes see.

The memory has no name: it is a file that exists only as long as one of the two processes has it open, so nothing is left behind, however they end.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import tempfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.plain_files import MAX_PIXELS

SLOTS = 4
"""Frames that may be under way at once."""
_ALIGNMENT = 64
PLANES: Mapping[str, tuple[str, int | None]] = {
    "image": ("|u1", 3),
    "right_image": ("|u1", 3),
    "depth": ("<f4", None),
    "mask": ("|u1", None),
    "pose": ("<f8", None),
}
"""A frame's fields that are arrays: their type, and how many channels the picture has."""


class BadHeader(Exception):
    """What one process says of a frame does not fit the memory."""


def new_memory() -> int:
    """A file descriptor of shared memory, empty, that a child process may inherit."""
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("frames", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        # Memory that shrinks under a reader would kill it.
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        return fd
    with tempfile.TemporaryFile() as file:  # has no name either
        return os.dup(file.fileno())


class FrameWriter:
    """The side that puts frames there."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._memory: mmap.mmap | None = None
        self._slot_bytes = 0

    def fits(self, planes: Mapping[str, NDArray]) -> bool:
        """Whether a frame fits into a slot as they are."""
        return _laid_out(planes)[1] <= self._slot_bytes

    def grow(self, planes: Mapping[str, NDArray]) -> None:
        """Make the slots as large as this frame; no slot may be in use."""
        if self._memory is not None:
            self._memory.close()
        self._slot_bytes = _laid_out(planes)[1]
        os.ftruncate(self._fd, SLOTS * self._slot_bytes)
        self._memory = mmap.mmap(self._fd, SLOTS * self._slot_bytes)

    def write(self, slot: int, planes: Mapping[str, NDArray]) -> list[Any]:
        """Copy a frame's arrays into a slot; what the other side needs to find them."""
        assert self._memory is not None
        begins, _ = _laid_out(planes)
        found = []
        for (name, plane), begin in zip(planes.items(), begins, strict=True):
            offset = slot * self._slot_bytes + begin
            kind = np.dtype(PLANES[name][0])
            there = np.frombuffer(self._memory, kind, plane.size, offset).reshape(plane.shape)
            there[...] = plane
            del there  # the memory cannot be closed while an array points into it
            found.append([name, offset, list(plane.shape)])
        return found


class FrameReader:
    """The side that takes frames out."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._memory: mmap.mmap | None = None

    def read(self, found: Any) -> dict[str, NDArray]:
        """Copies of a frame's arrays. Raises BadHeader for what cannot be a frame or lies outside of the memory."""
        if not isinstance(found, list) or not 1 <= len(found) <= len(PLANES):
            raise BadHeader(f"a frame cannot have the arrays {found!r:.80}")
        return {name: self._plane(name, offset, shape) for name, offset, shape in found}

    def close(self) -> None:
        """Let go of the memory."""
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def _plane(self, name: Any, offset: Any, shape: Any) -> NDArray:
        if name not in PLANES or not isinstance(shape, list):
            raise BadHeader(f"a frame has no array {name!r:.40} of shape {shape!r:.40}")
        kind, channels = PLANES[name]
        wanted = [4, 4] if name == "pose" else [*shape[:2], *([] if channels is None else [channels])]
        whole = all(type(side) is int and 0 < side <= MAX_PIXELS for side in [*shape, *wanted])
        if len(shape) < 2 or shape != wanted or not whole or shape[0] * shape[1] > MAX_PIXELS:
            raise BadHeader(f"{name} cannot have the shape {shape!r:.40}")
        count = int(np.prod(shape))
        end = offset + count * np.dtype(kind).itemsize if type(offset) is int and offset >= 0 else -1
        if self._memory is None or end > len(self._memory):
            self._map()
        if self._memory is None or not 0 < end <= len(self._memory):
            raise BadHeader(f"{name} of shape {shape} at byte {offset!r:.20} lies outside of the shared memory")
        return np.frombuffer(self._memory, kind, count, offset).reshape(shape).copy()

    def _map(self) -> None:
        self.close()
        size = os.fstat(self._fd).st_size
        if size:
            self._memory = mmap.mmap(self._fd, size, prot=mmap.PROT_READ)


def _laid_out(planes: Mapping[str, NDArray]) -> tuple[list[int], int]:
    """Where each array of a frame begins within a slot, and how many bytes they take."""
    begins, end = [], 0
    for name, plane in planes.items():
        begins.append(end)
        size = plane.size * np.dtype(PLANES[name][0]).itemsize
        end += -(-size // _ALIGNMENT) * _ALIGNMENT
    return begins, end
