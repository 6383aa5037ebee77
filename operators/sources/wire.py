"""Messages between a capture process and its parent: JSON, with frame arrays in shared memory.

Shared memory for frames between two processes.

The memory is an anonymous file, which exists only while one of the processes has it open. It leaves nothing behind
even after a crash.
"""

from __future__ import annotations

import fcntl
import json
import math
import mmap
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.plain_files import MAX_PIXELS
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_origin import DEPTH_ORIGINS
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.sources.options import SourceOptions
from operators.sources.source import SourceDescription

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


MOST_BYTES = 1 << 20
"""Maximum size of a message in bytes."""


def message(kind: str, **content: Any) -> bytes:
    """Encode a message."""
    return json.dumps({"kind": kind, **content}).encode()


def parsed(data: bytes) -> dict[str, Any]:
    """Decode a message. Raises BadHeader."""
    try:
        content = json.loads(data)
    except ValueError as error:
        raise BadHeader(f"{data[:40]!r} is not JSON: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("kind"), str):
        raise BadHeader(f"{data[:40]!r} is not a message")
    return content


def options_to(options: SourceOptions) -> dict[str, Any]:
    """Convert options to JSON values."""
    return asdict(options)


def options_from(content: dict[str, Any]) -> SourceOptions:
    """Create options from JSON values."""
    return SourceOptions(**content)


def description_to(about: SourceDescription) -> dict[str, Any]:
    """Convert a description to JSON values."""
    return {
        "name": about.name,
        "width_px": about.width_px,
        "height_px": about.height_px,
        "fps": about.fps,
        "camera": camera_to(about.camera),
        "fields": sorted(about.fields),
        "frame_count": about.frame_count,
        "notes": list(about.notes),
    }


def camera_to(camera: Camera) -> dict[str, Any]:
    """Convert a camera to JSON values."""
    return {
        "K": camera.K.tolist(),
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "world_to_camera": camera.world_to_camera.tolist(),
        "model": camera.model,
    }


def description_from(content: dict[str, Any]) -> SourceDescription:
    """Create a description from JSON values. Raises BadHeader."""
    try:
        camera = Camera(**content["camera"])
        fields, notes = frozenset(content["fields"]), tuple(content["notes"])
        return SourceDescription(**{**content, "camera": camera, "fields": fields, "notes": notes})
    except (KeyError, TypeError, ValueError) as error:
        raise BadHeader(f"this describes no source: {error}") from error


def planes_of(frame: Frame) -> dict[str, NDArray]:
    """Return the arrays of a frame by field."""
    planes = {name: getattr(frame, name) for name in PLANES}
    return {name: plane for name, plane in planes.items() if plane is not None}


def frame_header(frame: Frame) -> dict[str, Any]:
    """Return the fields of a frame other than arrays as JSON values."""
    return {
        "seq": frame.seq,
        "pts_ns": frame.pts_ns,
        "arrived_ns": frame.arrived_ns,
        "status": frame.status.value,
        "damage": frame.damage,
        "depth_origin": None if frame.depth_origin is None else frame.depth_origin.name,
        "right_camera": None if frame.right_camera is None else camera_to(frame.right_camera),
    }


def frame_from(header: Mapping[str, Any], planes: Mapping[str, Any]) -> Frame:
    """Create a frame from its header and arrays. Raises BadHeader."""
    try:
        seq, pts_ns, arrived_ns, damage = (header[name] for name in ("seq", "pts_ns", "arrived_ns", "damage"))
        whole = all(type(value) is int and abs(value) < 2**62 for value in (seq, pts_ns))
        if not whole or not isinstance(damage, str | None) or type(arrived_ns) not in (int, type(None)):
            raise BadHeader(f"a frame cannot have the number {seq!r:.30} and the time {pts_ns!r:.30}")
        origin, right_camera = header.get("depth_origin"), header.get("right_camera")
        return Frame(
            seq=seq,
            pts_ns=pts_ns,
            arrived_ns=arrived_ns,
            status=FrameStatus(header["status"]),
            damage=damage,
            depth_origin=None if origin is None else DEPTH_ORIGINS[origin],
            right_camera=None if right_camera is None else Camera(**right_camera),
            **planes,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise BadHeader(f"this is no frame: {error}") from error


def finite_counts(content: Any) -> dict[str, int]:
    """Return the valid counts of a JSON object; empty if it is not an object."""
    if not isinstance(content, dict):
        return {}
    return {str(name): int(times) for name, times in content.items() if isinstance(times, int) and math.isfinite(times)}


def as_contiguous(planes: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return the arrays in contiguous memory."""
    return {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
