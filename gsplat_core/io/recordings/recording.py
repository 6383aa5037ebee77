"""Opening and validating recordings.

The held-out split is the one customary for endoscopic reconstruction: frames with (i - 1) % 8 == 0 (1, 9, 17, …) are test frames.

EndoGaussian, Deform3DGS and SurgicalGaussian use it on EndoNeRF's clips, which have no official split.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from gsplat_core.endoscope.sequence import picture_fault
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.recordings.contents import Contents
from gsplat_core.io.recordings.layouts import inspect
from gsplat_core.io.recordings.plain_files import (
    DEPENDS,
    MAX_PIXELS,
    DamagedFrames,
    Findings,
    ValidationReport,
    printable,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus, resized_frame

if TYPE_CHECKING:
    from gsplat_core.io.sessions.reader import SessionContents

MAX_REPORTED_PROBLEMS = 100
_DAMAGE_ADVICE = "Damaged frames are shown, but neither trained on nor scored; copy the file again from its source"
MIN_SCALED_SIDE_PX = 8
"""Minimum side in pixels after scaling."""


@runtime_checkable
class Recording(Protocol):
    """Interface of re-iterable frame sources that read one frame at a time."""

    name: str
    frame_count: int
    width_px: int
    height_px: int
    fps: float
    camera: Camera
    """Camera of frame 0."""
    notes: tuple[str, ...]
    """Sentences about fallbacks that were applied."""
    fields: frozenset[str]
    """Optional frame fields that are present: any of mask, depth, right_image, pose, labels and ranges."""
    stereo_baseline_mm: float | None
    """Distance of the right eye along the camera's x axis in mm; None if unknown."""

    @property
    def digest(self) -> str:
        """Return the SHA-256 over all files of the recording."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Yield all frames in order, decoded on demand."""
        ...

    def camera_at(self, index: int) -> Camera:
        """Return the camera of one frame."""
        ...


class FileRecording:
    """Recording on disk, read at a scale. Memory use does not depend on its length."""

    def __init__(
        self, contents: Contents | SessionContents, scale: float, max_frames: int | None, notes: tuple[str, ...]
    ) -> None:
        self._contents = contents
        # A relative path such as `.` has no name.
        self.name = printable(contents.root.name or contents.root.resolve().name)
        self.camera = contents.calibration.camera.scaled(scale)
        self.camera_is_assumed = contents.calibration.assumed
        """True if the intrinsics are a guess because the recording does not contain any."""
        self.width_px, self.height_px = self.camera.width_px, self.camera.height_px
        self.frame_count = min(contents.images.frame_count, max_frames or contents.images.frame_count)
        self.fps = contents.fps
        self.fields = contents.fields
        self.stereo_baseline_mm = contents.stereo_baseline_mm
        self.notes = notes

    @cached_property
    def digest(self) -> str:
        """Return the sha256 of all input files, independent of scale and frame limit."""
        return self._contents.digest()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order.

        Raises:
            RecordingInvalid: at the first frame that cannot be read.
        """
        # Close the inner generator explicitly. Python 3.12 would close it only when the outer generator is collected.
        with closing(self._contents.frames(Findings(strict=True), self.frame_count)) as frames:
            for frame in frames:
                assert frame is not None  # with strict findings, a problem raises instead of yielding None
                yield resized_frame(frame, self.width_px, self.height_px)

    def __len__(self) -> int:
        return self.frame_count

    def camera_at(self, index: int) -> Camera:
        """Return the camera of one frame; that of frame 0 if poses are unknown."""
        if not 0 <= index < self.frame_count:
            raise InvalidInput(f"frame {index} is not in the recording {self.name} of {self.frame_count} frames")
        poses = self._contents.calibration.poses
        return self.camera if poses is None else self.camera.with_pose(poses[index])


def open_recording(path: str | os.PathLike[str], *, scale: float = 1.0, max_frames: int | None = None) -> FileRecording:
    """Open a recording, with its layout recognised from the files (see `layouts`).

    Counts, header sizes, calibration and mask polarity are checked here. Frame data are checked during iteration.

    Args:
        path: video file or folder.
        scale: factor on the picture size. Images are area-averaged, masks and depth use the nearest pixel, and the
            camera is scaled accordingly.
        max_frames: read only the first frames; None reads all.

    Raises:
        RecordingMissing: if a file does not exist; the message names the file and the remedy.
        RecordingInvalid: if a file is wrong; the message names the file, the value and the remedy.
        InvalidSetting: if `scale` is not positive or leads to unsupported frame sizes, or `max_frames` is below 1.
    """
    if not 0 < scale < float("inf"):
        raise InvalidSetting(f"scale must be a positive number, got {scale}")
    if max_frames is not None and max_frames < 1:
        raise InvalidSetting(f"max_frames must be at least 1, got {max_frames}")
    findings = Findings(strict=True)
    contents = inspect(Path(path), findings)
    assert contents is not None  # with strict findings, a problem raises instead of returning None
    _check_scaled_size(contents.images.width_px, contents.images.height_px, scale)
    return FileRecording(contents, scale, max_frames, tuple(str(finding) for finding in findings.warnings))


def _check_scaled_size(width_px: int, height_px: int, scale: float) -> None:
    if scale == 1:
        return
    # No overflow check is needed, because Python floats overflow to infinity, which the range check rejects.
    width, height = width_px * scale, height_px * scale
    if width * height > MAX_PIXELS or min(width, height) < MIN_SCALED_SIDE_PX:
        least = MIN_SCALED_SIDE_PX / min(width_px, height_px)
        most = (MAX_PIXELS / (width_px * height_px)) ** 0.5
        raise InvalidSetting(
            f"scale {scale:g} makes frames of {width:.4g}x{height:.4g} px from {width_px}x{height_px}; "
            f"choose one from {least:.3g} to {most:.3g}: both sides at least {MIN_SCALED_SIDE_PX} px, and at most {MAX_PIXELS} pixels"
        )


def validate_recording(path: str | os.PathLike[str]) -> ValidationReport:
    """Read an entire recording, or up to `MAX_REPORTED_PROBLEMS`, and list its problems. A bad recording raises no
    exception."""
    findings = Findings()
    contents = inspect(Path(path), findings)
    if contents is None:
        return ValidationReport({"path": printable(os.fspath(path))}, findings.problems, findings.warnings)
    decoded = intact = causes = 0
    tissue = 0.0
    empty: Counter[str] = Counter()
    damaged = DamagedFrames()
    for frame in contents.frames(findings):
        if len(findings.problems) >= MAX_REPORTED_PROBLEMS:
            findings.warn(contents.root, f"more than {MAX_REPORTED_PROBLEMS} problems", "The rest was not looked at")
            break
        if frame is None:
            continue
        decoded += 1
        if frame.status is FrameStatus.DAMAGED:
            damaged.add(frame.seq)
            causes += not str(frame.damage).startswith(DEPENDS)
            if causes <= MAX_REPORTED_PROBLEMS and not str(frame.damage).startswith(DEPENDS):
                findings.warn(f"{contents.root}, frame {frame.seq}", f"it is damaged: {frame.damage}", _DAMAGE_ADVICE)
        else:
            intact += 1
            empty.update([fault] if (fault := picture_fault(frame.image)) else [])
            tissue += 1.0 if frame.mask is None else float(frame.mask.mean())
    if damaged.count:
        what = f"{damaged.count} frames are damaged, or may depend on damaged ones: {damaged.numbers()}"
        findings.warn(contents.root, what, _DAMAGE_ADVICE)
    if empty:
        causes_of = ", ".join(f"{fault}: {count}" for fault, count in empty.most_common())
        what = f"{empty.total()} of {decoded} frames show nothing ({causes_of})"
        findings.warn(contents.root, what, "They are withheld, and nothing is trained on them")
    images, calibration = contents.images, contents.calibration
    facts: dict[str, object] = {
        "path": printable(os.fspath(path)),
        "layout": contents.layout,
        "frames": images.frame_count,
        "frames_decoded": decoded,
        "frames_damaged": damaged.count,
        "damaged_frames": damaged.numbers(),
        "width_px": images.width_px,
        "height_px": images.height_px,
        "fps": contents.fps,
        "duration_s": images.frame_count / contents.fps,
        "fields": sorted(contents.fields),
        "calibration": calibration.source,
        "focal_px": [float(calibration.camera.K[0, 0]), float(calibration.camera.K[1, 1])],
        "camera_moves": calibration.poses is not None and bool(np.ptp(calibration.poses, axis=0).max() > 1e-9),
        "tissue_share": tissue / intact if intact else None,
        "tool_share": contents.tool_share,
        "stereo_baseline_mm": contents.stereo_baseline_mm,
    }
    return ValidationReport(facts, findings.problems, findings.warnings)


HELDOUT_STRIDE = 8


def is_heldout(index: int) -> bool:
    """Return True if the frame with this 0-based index is held out from training."""
    return (index - 1) % HELDOUT_STRIDE == 0
