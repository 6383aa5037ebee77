"""File type detection of uploads by their first bytes."""

from __future__ import annotations

from pathlib import Path

from services.errors import Rejected

ARCHIVE = "archive"


def kind_of(file: Path) -> str:
    """Return `archive`, or the suffix of a video (`.mp4`, `.avi`, `.mkv`).

    Raises:
        Rejected: if the type is unknown.
    """
    with open(file, "rb") as opened:
        head = opened.read(16)
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return ARCHIVE
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide"):
        return ".mp4"
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return ".avi"
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return ".mkv"
    raise Rejected(
        "the file is neither a video (MP4, AVI, Matroska) nor a zip archive; pack a recording's folder with `zip -r`"
    )
