"""Reading video: what the container says first, then frames in order, never by seeking.

Only containers that are known by their first bytes reach the decoder. FFmpeg guesses formats from content, and a text
file in a playlist format could make it open other files or network addresses.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.image_files import MAX_PIXELS, quiet_decoder

VIDEO_SUFFIXES = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm"})
_ISO_FIRST_BOXES = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide"})
_REENCODE = "Copy the file again from its source, or re-encode it (ffmpeg -i IN -c:v libx264 OUT.mp4)"


@contextmanager
def _capture(path: Path) -> Iterator[cv2.VideoCapture]:
    # Read by OpenCV when FFmpeg is first used in the process; -8 is AV_LOG_QUIET. An operator's own setting wins.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with quiet_decoder():
        # An absolute path, so that no name (`concat:…`) is taken for a protocol.
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    try:
        yield capture
    finally:
        capture.release()


class VideoFrames:
    """The frames of a video file, in order, decoded one at a time."""

    def __init__(self, path: Path, frame_count: int, width_px: int, height_px: int, fps: float) -> None:
        self.path = path
        self.files: tuple[Path, ...] = (path,)
        self.numbers: list[int | None] = list(range(frame_count))
        self.frame_count = frame_count
        self.width_px = width_px
        self.height_px = height_px
        self.fps: float | None = fps

    def frames(self, findings: Findings) -> Iterator[NDArray[np.uint8] | None]:
        """RGB uint8 [H, W, 3], frame after frame. A video that ends early is a problem."""
        with _capture(self.path) as capture:
            for index in range(self.frame_count):
                decoded, image = capture.read()
                if not decoded:
                    findings.problem(
                        self.path,
                        f"the video ends early: {index} of {self.frame_count} announced frames could be decoded",
                        f"{_REENCODE}, or replay only its beginning (--max-frames {index})",
                    )
                    return
                if image.shape != (self.height_px, self.width_px, 3):
                    findings.problem(
                        self.path,
                        f"frame {index} is {image.shape[1]}x{image.shape[0]}, the first one is "
                        f"{self.width_px}x{self.height_px}",
                        _REENCODE,
                    )
                    yield None
                    continue
                yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def open_video(path: Path, findings: Findings) -> VideoFrames | None:
    """Check the container and the first frame; None where there is a problem."""
    exact_count = _check_container(path, findings)
    if exact_count is None:
        return None
    with _capture(path) as capture:
        width_px = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height_px = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if width_px * height_px > MAX_PIXELS:
            findings.problem(
                path, f"frames of {width_px}x{height_px} exceed the bound of {MAX_PIXELS} pixels", "Scale it down"
            )
            return None
        announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        fps = capture.get(cv2.CAP_PROP_FPS)
        decoded, image = capture.read()
        if not decoded:
            findings.problem(path, "no frame of the video can be decoded", _REENCODE)
            return None
        height_px, width_px = image.shape[:2]
        frame_count = int(announced)
        if not exact_count or frame_count < 1:
            # These containers only estimate their length.
            frame_count = 1
            while capture.grab():
                frame_count += 1
            if frame_count < 0.98 * announced - 2:
                findings.problem(
                    path, f"the video ends early: {frame_count} of about {announced:.0f} frames are there", _REENCODE
                )
    if not 0.1 <= fps <= 1000:
        findings.warn(path, f"the container announces {fps} frames/s", "30 frames/s are assumed")
        fps = 30.0
    return VideoFrames(path, frame_count, width_px, height_px, float(fps))


def _check_container(path: Path, findings: Findings) -> bool | None:
    """None: a problem. True: the announced frame count is exact. False: it is an estimate."""
    if not path.is_file():  # opening a pipe would wait for ever
        findings.problem(path, "it is not a plain file", "Give a video file")
        return None
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            head = stream.read(16)
            if head[4:8] in _ISO_FIRST_BOXES:
                return _check_iso_boxes(path, size, findings)
    except OSError as error:
        findings.problem(path, f"the file cannot be read: {error.strerror or error}", "Check the file")
        return None
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        riff_end = 8 + int.from_bytes(head[4:8], "little")
        if riff_end > size:
            findings.problem(path, f"the video is cut off: {size} of {riff_end} bytes are there", _REENCODE)
            return None
        return False
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return False
    what = "is empty (0 bytes)" if not head else f"is not a video (it begins with {head[:12]!r})"
    findings.problem(path, f"the file {what}", "Give an MP4/MOV, AVI or Matroska/WebM file")
    return None


def _check_iso_boxes(path: Path, size: int, findings: Findings) -> bool | None:
    """Walk the top-level boxes of an MP4 (ISO/IEC 14496-12, 4.2): all of them complete, and the index among them."""
    seen: set[bytes] = set()
    at = 0
    with path.open("rb") as stream:
        while at + 8 <= size:
            stream.seek(at)
            header = stream.read(16)
            kind, length = header[4:8], int.from_bytes(header[:4], "big")
            if length == 1:
                length = int.from_bytes(header[8:16], "big")
            elif length == 0:
                length = size - at
            if length < 8:
                findings.problem(path, f"the box at byte {at} announces {length} bytes", _REENCODE)
                return None
            if at + length > size:
                findings.problem(
                    path,
                    f"the video is cut off: part {kind.decode('latin-1')!a} goes to byte {at + length}, "
                    f"the file ends at byte {size}",
                    _REENCODE,
                )
                return None
            seen.add(kind)
            at += length
    if b"moov" not in seen:
        findings.problem(path, "the video is cut off: its index (part 'moov') is missing", _REENCODE)
        return None
    return b"moof" not in seen
