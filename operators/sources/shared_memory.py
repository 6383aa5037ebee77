"""Shared memory for frames between two processes.

The memory is an anonymous file, which exists only while one of the processes has it open. It leaves
nothing behind even after a crash.
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
"""Number of frames in flight."""
_ALIGNMENT = 64
PLANES: Mapping[str, tuple[str, int | None]] = {
    "image": ("|u1", 3),
    "right_image": ("|u1", 3),
    "depth": ("<f4", None),
    "mask": ("|u1", None),
    "pose": ("<f8", None),
}
"""Array fields of a frame: data type and number of channels."""


class BadHeader(Exception):
    """The header of a frame does not match the shared memory."""


def new_memory() -> int:
    """Return a file descriptor of empty shared memory, inheritable by a child process through
    `pass_fds`.
    """
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("frames", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        # Shrinking the memory would crash the reader.
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        return fd
    with tempfile.TemporaryFile() as file:  # also anonymous
        return os.dup(file.fileno())


class FrameWriter:
    """Writer of frames to shared memory."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._memory: mmap.mmap | None = None
        self._slot_bytes = 0

    def fits(self, planes: Mapping[str, NDArray]) -> bool:
        """Return True if the frame's arrays fit into a slot."""
        return _laid_out(planes)[1] <= self._slot_bytes

    def grow(self, planes: Mapping[str, NDArray]) -> None:
        """Enlarge the slots for this frame; no slot may be in use."""
        if self._memory is not None:
            self._memory.close()
        self._slot_bytes = _laid_out(planes)[1]
        os.ftruncate(self._fd, SLOTS * self._slot_bytes)
        self._memory = mmap.mmap(self._fd, SLOTS * self._slot_bytes)

    def write(self, slot: int, planes: Mapping[str, NDArray]) -> list[Any]:
        """Copy a frame's arrays into a slot.

        Args:
            slot: number of the slot, which must be free.
            planes: arrays by field, as in `PLANES`.

        Returns:
            Name, offset in bytes and shape of each array, as `FrameReader.read` expects them.
        """
        assert self._memory is not None
        begins, _ = _laid_out(planes)
        found = []
        for (name, plane), begin in zip(planes.items(), begins, strict=True):
            offset = slot * self._slot_bytes + begin
            kind = np.dtype(PLANES[name][0])
            there = np.frombuffer(self._memory, kind, plane.size, offset).reshape(plane.shape)
            there[...] = plane
            del there  # mmap cannot be closed while an array refers to it
            found.append([name, offset, list(plane.shape)])
        return found


class FrameReader:
    """Reader of frames from shared memory."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._memory: mmap.mmap | None = None

    def read(self, found: Any) -> dict[str, NDArray]:
        """Return copies of a frame's arrays. Raises BadHeader for invalid arrays or positions."""
        if not isinstance(found, list) or not 1 <= len(found) <= len(PLANES):
            raise BadHeader(f"a frame cannot have the arrays {found!r:.80}")
        return {name: self._plane(name, offset, shape) for name, offset, shape in found}

    def close(self) -> None:
        """Unmap the memory."""
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
    """Return the offset of each array within a slot, and the total size in bytes."""
    begins, end = [], 0
    for name, plane in planes.items():
        begins.append(end)
        size = plane.size * np.dtype(PLANES[name][0]).itemsize
        end += -(-size // _ALIGNMENT) * _ALIGNMENT
    return begins, end
