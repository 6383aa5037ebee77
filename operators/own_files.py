"""Recognition of this program's output files by content, so that `--overwrite` replaces only those.

Each format carries a mark: a comment in `.ply` and `.mp4`, the generator of `.glb`, bytes after the
array of `.npy`. A `.splat` has no space for a mark, so its rows are validated instead.
"""

from __future__ import annotations

import json
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsplat_core.io.exports.export import TIMES_FILE
from gsplat_core.io.exports.files import ROW
from gsplat_core.io.files import open_regular
from gsplat_core.io.ply import MARK_LINE
from gsplat_core.io.recordings.calibration import TRAILER

_MOST_JSON_BYTES = 64 << 20


def is_own_file(path: Path) -> bool:
    """Return True if the file has the mark for its suffix. False for a missing or unreadable
    file.
    """
    recognise = _KINDS.get(path.suffix.lower())
    if recognise is None:
        return False
    try:
        with open_regular(path) as file:
            return recognise(file)
    except (OSError, ValueError, KeyError, TypeError, RecursionError, struct.error, zipfile.BadZipFile):
        return False


def _ply(file: BinaryIO) -> bool:
    return any(line.strip() == MARK_LINE.encode() for line in file.read(512).split(b"\n")[:4])


def _glb(file: BinaryIO) -> bool:
    magic, _, _, length, kind = struct.unpack("<4sIII4s", file.read(20))
    if magic != b"glTF" or kind != b"JSON" or length > _MOST_JSON_BYTES:
        return False
    return json.loads(file.read(length))["asset"]["generator"] == "IntraSplat"


def _npy(file: BinaryIO) -> bool:
    if file.read(6) != b"\x93NUMPY":
        return False
    file.seek(-len(TRAILER), os.SEEK_END)
    return file.read() == TRAILER


def _mp4(file: BinaryIO) -> bool:
    import av

    from operators.sinks.video_file import MARK

    try:
        with av.open(file, format="mp4") as container:
            return container.metadata.get("comment") == MARK
    except av.FFmpegError:
        return False


def _splat(file: BinaryIO) -> bool:
    data = file.read(1 << 24)
    size = os.fstat(file.fileno()).st_size
    if not data or size % ROW.itemsize:
        return False
    rows = np.frombuffer(data[: len(data) - len(data) % ROW.itemsize], ROW)
    return bool(np.isfinite(rows["position"]).all() and np.isfinite(rows["scale"]).all() and (rows["scale"] >= 0).all())


def _sequence(file: BinaryIO) -> bool:
    with zipfile.ZipFile(file) as archive:
        return archive.namelist()[:2] == [TIMES_FILE, "0000.ply"]


def _packed(file: BinaryIO) -> bool:
    """Return True for a tar archive whose first member is a manifest, as written by `pack`."""
    block = file.read(512)
    return block[:100].rstrip(b"\0") == b"manifest.json" and block[257:262] == b"ustar"


def _page(file: BinaryIO) -> bool:
    head = file.read(4096)
    return head.startswith(b"<!doctype html>") and b"IntraSplat" in head


def _report(file: BinaryIO) -> bool:
    values = json.loads(file.read(_MOST_JSON_BYTES))
    return isinstance(values, dict) and {"series", "outputs", "notes"} <= set(values)


def _frames(file: BinaryIO) -> bool:
    entry = json.loads(file.readline(1 << 16))
    return isinstance(entry, dict) and {"seq", "psnr_tissue_db"} <= set(entry)


_KINDS: dict[str, Callable[[BinaryIO], bool]] = {
    ".ply": _ply,
    ".glb": _glb,
    ".npy": _npy,
    ".mp4": _mp4,
    ".splat": _splat,
    ".zip": _sequence,
    ".isplat": _packed,
    ".html": _page,
    ".json": _report,
    ".jsonl": _frames,
}
