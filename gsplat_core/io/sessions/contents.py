"""Session recording as an ordinary recording of its received frames, for replay and evaluation."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.frame_codec import camera_of
from gsplat_core.io.recordings.calibration import Calibration, default_calibration
from gsplat_core.io.recordings.contents import digest_of
from gsplat_core.io.recordings.decoder import NO_PICTURE
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.sessions.reader import SessionReader
from gsplat_core.io.sessions.records import SESSION_FILE, FrameLine
from gsplat_core.scene.frames import Frame, FrameStatus

_ADVICE = "What can be read is played"


@dataclass(frozen=True)
class SessionImages:
    """Number and size of a session's frames."""

    frame_count: int
    width_px: int
    height_px: int


@dataclass(frozen=True)
class SessionContents:
    """Contents of a session; counterpart of `Contents` for other layouts.

    A recording has a single picture size. Frames of another size than the first one are skipped.
    """

    root: Path
    reader: SessionReader
    images: SessionImages
    calibration: Calibration
    fps: float
    fields: frozenset[str]
    layout: str = "session"
    tool_share: float | None = None
    stereo_baseline_mm: float | None = None

    def frames(self, findings: Findings, limit: int | None = None) -> Generator[Frame | None, None, None]:
        """Yield the frames in order, with their numbers and times in the session."""
        yield from islice(self._frames(findings), limit)

    def _frames(self, findings: Findings) -> Iterator[Frame | None]:
        last: Frame | None = None
        for line, decoded in self.reader.frames():
            if not self._fits(line):
                continue
            frame = decoded
            if frame is None and last is not None:
                nothing = np.zeros(last.image.shape[:2], np.uint8)
                frame = last.with_fields(
                    seq=line.seq, pts_ns=line.pts_ns, status=FrameStatus.DAMAGED, damage=NO_PICTURE, mask=nothing
                )
            if frame is None:
                findings.problem(
                    self.root, f"the image of frame {line.seq} cannot be decoded", "Copy the session again"
                )
            else:
                last = frame
            yield frame

    def files(self) -> list[Path]:
        """Return every file that is read."""
        return self.reader.files()

    def digest(self) -> str:
        """Return the digest of all files; see `digest_of`."""
        return digest_of(self.root, self.files())

    def _fits(self, line: FrameLine) -> bool:
        return (line.width_px, line.height_px) == (self.images.width_px, self.images.height_px)


def session_contents(path: Path, findings: Findings) -> SessionContents | None:
    """Open the recording of a session; None after a problem."""
    try:
        reader = SessionReader(path)
    except RecordingInvalid as error:
        findings.problem(path / SESSION_FILE, str(error), "Copy the session again")
        return None
    for note in reader.notes:
        findings.warn(path, note, _ADVICE)
    first = reader.first
    if first is None:
        findings.problem(path, "no frame of the session can be read", "Copy it again from its source")
        return None
    size = first.width_px, first.height_px
    count, others, poses = _of_size(reader, size)
    if others:
        findings.warn(
            path,
            f"{others} of {count + others} frames have another size than the first one, {size[0]}x{size[1]} px",
            "They are left out",
        )
    camera = camera_of(reader.info.camera)
    calibration = Calibration(camera, None, SESSION_FILE)
    if (camera.width_px, camera.height_px) != size:
        calibration = default_calibration(path, *size, findings)
    if poses is not None:
        calibration = replace(calibration, poses=poses, camera=calibration.camera.with_pose(poses[0]))
    return SessionContents(
        root=path,
        reader=reader,
        images=SessionImages(count, *size),
        calibration=calibration,
        fps=reader.info.fps,
        fields=frozenset(reader.fields),
    )


def _of_size(reader: SessionReader, size: tuple[int, int]) -> tuple[int, int, NDArray[np.float64] | None]:
    """Return the numbers of frames with and without this size, and the poses [N, 4, 4].

    The poses are None unless every frame of this size has one.
    """
    poses: list[NDArray[np.float64]] = []
    count = others = 0
    for line in reader.frame_lines():
        if (line.width_px, line.height_px) != size:
            others += 1
            continue
        count += 1
        if line.pose is not None:
            poses.append(np.array(line.pose).reshape(4, 4))
    return count, others, np.stack(poses) if len(poses) == count else None
