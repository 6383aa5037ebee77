"""What is truly so in a recording, for evaluation alone: further cameras, points of the tissue that are followed, depth without noise.

    tracks.npy          float [frames, points, 3]: points of the tissue in the recording's world
    tracks_seen.npy     [frames, points]: 1 where the left eye sees the point
    true_depth/         as depth/, where that one is not the truth
    flow/, scene_flow/  where what each pixel shows goes until the next frame (`true_motion`)
    views.json, views/  further cameras (`views`)
    behind/images, behind/depth  the left eye's picture and depth through its tools

Nothing here is read by training, nor is it part of a recording's digest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.arrays import ArrayHeader, read_array
from gsplat_core.io.recordings.calibration import number, read_json
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.frame_files import DepthFiles, check_sizes, resize_area, resize_nearest
from gsplat_core.io.recordings.image_files import decode_picture, list_images
from gsplat_core.io.recordings.plain_files import UnreadableFile, all_stay_inside, stays_inside
from gsplat_core.io.recordings.true_motion import MotionFiles, open_motion
from gsplat_core.io.recordings.views import RecordedView, open_views
from gsplat_core.scene.frames import Frame

MOST_POINTS = 4096
"""Points that are followed."""


@dataclass(frozen=True)
class Tracks:
    """Points of the tissue over time."""

    points: NDArray[np.float64]
    """[frames, points, 3], in the recording's world."""
    seen: NDArray[np.bool_]
    """[frames, points]: whether the left eye sees the point."""


@dataclass(frozen=True)
class TissueBehindTools:
    """Pictures and depth of a recording as they are behind its tools."""

    images: tuple[Path, ...]
    depth: DepthFiles

    def of(self, frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.float32]] | None:
        """Return picture [H, W, 3] and depth z [H, W] in mm of a frame of the recording, at the frame's size; None after the last one.

        Raises RecordingInvalid for a file that cannot be read.
        """
        if frame.seq >= len(self.images):
            return None
        try:
            image = decode_picture(self.images[frame.seq]).image
        except UnreadableFile as error:
            raise RecordingInvalid(f"{self.images[frame.seq]}: {error}. Write it again, or remove behind/") from error
        depth = self.depth.read(frame.seq, Findings(strict=True))
        assert depth is not None
        size = frame.width_px, frame.height_px
        return resize_area(image, *size), resize_nearest(depth, *size)


@dataclass(frozen=True)
class GroundTruth:
    """What a recording knows beyond what a camera gives; the parts that it has not are None or empty."""

    views: tuple[RecordedView, ...] = ()
    tracks: Tracks | None = None
    true_depth: DepthFiles | None = None
    motion: MotionFiles | None = None
    behind: TissueBehindTools | None = None

    def depth_of(self, frame: Frame) -> NDArray[np.float32] | None:
        """The true depth of a frame of the recording, at the frame's size; the frame's own where there is no other."""
        if self.true_depth is None or frame.seq >= len(self.true_depth.files):
            return frame.depth
        depth = self.true_depth.read(frame.seq, Findings(strict=True))
        assert depth is not None
        return resize_nearest(depth, frame.width_px, frame.height_px)


def open_truth(folder: Path, frame_count: int, scale: float = 1.0) -> GroundTruth:
    """What the folder of a recording knows about its first `frame_count` frames. scale: at which they are read, and the views with them.

    Raises RecordingInvalid for what is there and cannot be read.
    """
    if not folder.is_dir():
        return GroundTruth()
    views = open_views(folder, frame_count, scale)
    tracks = _tracks(folder, frame_count)
    depth = _depth_files(folder, "true_depth", frame_count)
    return GroundTruth(views, tracks, depth, open_motion(folder, frame_count), open_behind(folder, frame_count))


def open_behind(folder: Path, frame_count: int) -> TissueBehindTools | None:
    """Return the tissue behind the tools of a recording's first `frame_count` frames; None where the recording does not know it.

    Raises RecordingInvalid for what is there and cannot be read.
    """
    depth = _depth_files(folder, "behind/depth", frame_count)
    if depth is None:
        return None
    inside = folder / "behind/images"
    files = list_images(inside) if inside.is_dir() else []
    if len(files) < frame_count or not all_stay_inside(folder, files, Findings(strict=True)):
        raise RecordingInvalid(f"{inside}: {len(files)} pictures for {frame_count} frames. Give one for each frame")
    return TissueBehindTools(tuple(files), depth)


def _tracks(folder: Path, frame_count: int) -> Tracks | None:
    seen = _array(folder / "tracks_seen.npy", frame_count, 2)
    points = _array(folder / "tracks.npy", frame_count, 3)
    if seen is None or points is None:
        return None
    if points.shape[1:] != (seen.shape[1], 3) or not np.isfinite(points).all():
        raise RecordingInvalid(
            f"{folder}: tracks.npy is {list(points.shape)} and tracks_seen.npy {list(seen.shape)}. Give [frames, points, 3] finite"
            " numbers, and [frames, points]"
        )
    return Tracks(points[:, :MOST_POINTS].astype(np.float64), (seen != 0)[:, :MOST_POINTS])


def _array(path: Path, frame_count: int, dimensions: int) -> NDArray[Any] | None:
    """An array with as many rows as there are frames, or more; None where there is no such file."""
    if not path.exists():
        return None
    stays_inside(path.parent, path, Findings(strict=True))

    def wrong(header: ArrayHeader) -> str | None:
        fits = len(header.shape) == dimensions and header.shape[0] >= frame_count and header.bytes <= 2**30
        return None if fits else f"it is {list(header.shape)!s:.80}, and there are {frame_count} frames"

    try:
        return read_array(path, wrong)
    except UnreadableFile as error:
        raise RecordingInvalid(f"{path}: {error}. Write it again, one row for each frame, or remove it") from error


def _depth_files(folder: Path, name: str, frame_count: int) -> DepthFiles | None:
    inside = folder / name
    if not inside.is_dir():
        return None
    files = list_images(inside) or list_images(inside, frozenset({".npy"}))
    findings = Findings(strict=True)
    if len(files) < frame_count or not all_stay_inside(folder, files, findings):
        raise RecordingInvalid(f"{inside}: {len(files)} depth maps for {frame_count} frames. Give one for each frame")
    size = check_sizes(files, None, "depth map", findings)
    assert size is not None
    described = read_json(folder / "recording.json", findings) or {}
    return DepthFiles(files, *size, number(described.get("depth_unit_mm")) or 1.0)
