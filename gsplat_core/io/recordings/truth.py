"""Ground truth of a recording, for evaluation alone: further cameras, followed points, motion, and depth without noise.

    tracks.npy          float [frames, points, 3]: points of the tissue in the recording's world
    tracks_seen.npy     [frames, points]: 1 where the left eye sees the point
    true_depth/         as depth/, where that one is not the truth
    flow/, scene_flow/  motion of each pixel to the next frame
    views.json          {"format": "intrasplat-views", "version": 1, "depth_unit_mm": 0.01,
                         "views": [{"name": "third", "folder": "views/third", "camera": {"width": 320, ...}, "left_to_view": [[...], ...]}]}
    views/third/        images/, one picture for each frame; optional masks/, 255 = tool; optional depth/, 16 bit PNG in `depth_unit_mm` or .npy in mm
    behind/images, behind/depth  the left eye's picture and depth through its tools

Training never reads these files, and a recording's digest does not cover them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.calibration import number, read_json, read_pinhole
from gsplat_core.io.recordings.contents import Beside
from gsplat_core.io.recordings.frame_files import (
    DepthFiles,
    ImageFiles,
    MaskFiles,
    check_sizes,
)
from gsplat_core.io.recordings.plain_files import (
    MAX_PIXELS,
    ArrayHeader,
    Findings,
    UnreadableFile,
    all_stay_inside,
    decode_picture,
    list_images,
    read_array,
    stays_inside,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, resize_area, resize_nearest, resized_frame

VIEWS_FILE = "views.json"
VIEWS_FORMAT = "intrasplat-views"
VIEWS_VERSION = 1
MOST_VIEWS = 16
"""Maximum number of additional cameras in a recording."""


@dataclass(frozen=True)
class RecordedView:
    """Additional camera rigidly attached to the recording's own camera, with its pictures."""

    name: str
    camera: Camera
    """Camera of the view. Its pose maps from coordinates of the recording's own camera to its own, as that of
    `Frame.right_camera`."""
    files: tuple[Path, ...]
    masks: MaskFiles | None
    depth: DepthFiles | None

    def read(self, index: int) -> Frame:
        """Read the view of a recording's frame at `camera`'s size, with mask and depth if available.

        Raises:
            RecordingInvalid: if a file cannot be used.
        """
        findings = Findings(strict=True)
        picture = next(ImageFiles(self.files[index : index + 1], 0, 0).frames(findings))
        assert picture is not None  # strict findings raise instead of returning None
        frame = Frame(
            seq=index,
            pts_ns=0,
            image=picture.image,
            mask=None if self.masks is None else self.masks.read(index, findings),
            depth=None if self.depth is None else self.depth.read(index, findings),
        )
        return resized_frame(frame, self.camera.width_px, self.camera.height_px)


def open_views(folder: Path, frame_count: int, scale: float = 1.0) -> tuple[RecordedView, ...]:
    """Open the additional cameras listed in `views.json`; empty without that file.

    Args:
        folder: folder of the recording.
        frame_count: number of frames that each view must cover.
        scale: factor on the picture size.

    Raises:
        RecordingInvalid: if `views.json` is invalid, a file cannot be read, or a view has too few pictures.
    """
    path = folder / VIEWS_FILE
    if not folder.is_dir() or not path.exists():
        return ()
    findings = Findings(strict=True)
    stays_inside(folder, path, findings)
    content = read_json(path, findings)
    assert content is not None
    views = content.get("views")
    if content.get("format") != VIEWS_FORMAT or content.get("version") != VIEWS_VERSION or not isinstance(views, list):
        raise RecordingInvalid(
            f"{path} does not describe views. Give format {VIEWS_FORMAT}, version {VIEWS_VERSION}, views"
        )
    if len(views) > MOST_VIEWS:
        raise RecordingInvalid(f"{path} has {len(views)} views. Give at most {MOST_VIEWS}")
    unit = number(content.get("depth_unit_mm", 1.0))
    if unit is None or not 1e-6 <= unit <= 1e3:
        raise RecordingInvalid(
            f"{path}: depth_unit_mm is {content['depth_unit_mm']!r:.40}. Give a number from 1e-6 to 1000"
        )
    found = tuple(_view(folder, path, view, unit, findings) for view in views)
    for view in found:
        if len(view.files) < frame_count:
            raise RecordingInvalid(
                f"{path}: {view.name} has {len(view.files)} pictures for {frame_count} frames. Give one for each frame of the recording"
            )
    return tuple(replace(view, camera=view.camera.scaled(scale)) for view in found)


def _view(root: Path, path: Path, described: Any, unit_mm: float, findings: Findings) -> RecordedView:
    if not isinstance(described, dict) or not isinstance(described.get("camera"), dict):
        raise RecordingInvalid(f"{path}: a view is {described!r:.60}. Give name, folder, camera and left_to_view")
    name, inside = described.get("name"), described.get("folder")
    if not isinstance(name, str) or not name.isidentifier() or not isinstance(inside, str):
        raise RecordingInvalid(
            f"{path}: a view has the name {name!r:.60} and the folder {inside!r:.60}. Give a word each"
        )
    if PurePosixPath(inside).is_absolute() or ".." in PurePosixPath(inside).parts:
        raise RecordingInvalid(f"{path}: the folder {inside!r:.60} is outside of the recording. Give one inside of it")
    folder = root / inside
    stays_inside(root, folder, findings)
    files = list_images(folder / "images") if (folder / "images").is_dir() else []
    if not files or not all_stay_inside(root, files, findings):
        raise RecordingInvalid(f"{folder / 'images'}: there are no pictures. Give one for each frame of the recording")
    camera = read_pinhole(path, described["camera"], findings)
    assert camera is not None
    size = check_sizes(files, (camera.width_px, camera.height_px), "view's picture", findings)
    assert size is not None
    images = ImageFiles(files, *size)
    beside = Beside(folder, images, findings)
    posed = camera.with_pose(_pose(path, described))
    return RecordedView(name, posed, images.files, beside.masks(), beside.depth(unit_mm))


def _pose(path: Path, described: dict[str, Any]) -> np.ndarray:
    try:
        pose = np.array(described.get("left_to_view"), np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    rotation = pose[:3, :3] if pose.shape == (4, 4) else np.zeros((3, 3))
    right = pose.shape == (4, 4) and np.isfinite(pose).all() and pose[3].tolist() == [0, 0, 0, 1]
    if not right or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
        raise RecordingInvalid(
            f"{path}: left_to_view of {described.get('name')!r:.40} is no pose. Give 4 x 4 numbers: a rotation, a position, (0, 0, 0, 1)"
        )
    return pose


@dataclass(frozen=True)
class TrueMotion:
    """Motion from one frame to the next at the size of the frame; NaN where unknown."""

    flow: NDArray[np.float32]
    """Optical flow to the next frame, [H, W, 2] in pixels."""
    scene_flow: NDArray[np.float32] | None
    """Displacement of the tissue to the next frame, [H, W, 3] in the recording's unit and world; None if not recorded.
    """


@dataclass(frozen=True)
class MotionFiles:
    """Optical-flow and scene-flow files of a recording, in frame order."""

    flow: tuple[Path, ...]
    scene_flow: tuple[Path, ...]
    """Scene-flow files; as many as `flow`, or none."""

    def of(self, frame: Frame) -> TrueMotion | None:
        """Read the motion of a frame's pixels; None if no file covers the frame.

        Raises:
            RecordingInvalid: if a file cannot be read.
        """
        if frame.seq >= len(self.flow):
            return None
        flow = _read_motion(self.flow[frame.seq], 2, frame)
        scale = np.array([frame.width_px / flow.shape[1], frame.height_px / flow.shape[0]], np.float32)
        scene_flow = _read_motion(self.scene_flow[frame.seq], 3, frame) if self.scene_flow else None
        size = frame.width_px, frame.height_px
        return TrueMotion(
            resize_nearest(flow, *size) * scale, None if scene_flow is None else resize_nearest(scene_flow, *size)
        )


def open_motion(folder: Path, frame_count: int) -> MotionFiles | None:
    """Open the motion files of a recording. Returns None if it has none.

    Raises:
        RecordingInvalid: if there are too few files.
    """
    flow = _motion_files(folder, "flow", frame_count)
    return None if flow is None else MotionFiles(flow, _motion_files(folder, "scene_flow", frame_count) or ())


def _motion_files(folder: Path, name: str, frame_count: int) -> tuple[Path, ...] | None:
    inside = folder / name
    if not inside.is_dir():
        return None
    files = list_images(inside, frozenset({".npy"}))
    if len(files) < frame_count - 1 or not all_stay_inside(folder, files, Findings(strict=True)):
        raise RecordingInvalid(f"{inside}: {len(files)} files for {frame_count} frames. Give one .npy for each frame")
    return tuple(files[:frame_count])


def _read_motion(path: Path, channels: int, frame: Frame) -> NDArray[np.float32]:
    def wrong(header: ArrayHeader) -> str | None:
        shape = header.shape
        if len(shape) != 3 or shape[2] != channels or not 0 < shape[0] * shape[1] <= MAX_PIXELS:
            return f"it is {list(shape)!s:.80} in place of [rows, columns, {channels}]"
        # Pictures read at another size have the same aspect ratio, up to rounding.
        unlike = abs(shape[0] * frame.width_px - shape[1] * frame.height_px) > max(shape[:2])
        return f"it is {list(shape)}, and the frame {frame.width_px}x{frame.height_px}" if unlike else None

    try:
        return read_array(path, wrong).astype(np.float32)
    except UnreadableFile as error:
        raise RecordingInvalid(f"{path}: {error}. Write it again in the size of the pictures, or remove it") from error


MOST_POINTS = 4096
"""Maximum number of tracked points."""


@dataclass(frozen=True)
class Tracks:
    """True positions of tracked tissue points in each frame."""

    points: NDArray[np.float64]
    """Positions of the points in the recording's world, [frames, points, 3]."""
    seen: NDArray[np.bool_]
    """Visibility of the points in the left eye, bool [frames, points]."""


@dataclass(frozen=True)
class TissueBehindTools:
    """Ground truth of the tissue behind tools: pictures and depth rendered as if the tools were transparent."""

    images: tuple[Path, ...]
    depth: DepthFiles

    def of(self, frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.float32]] | None:
        """Return picture [H, W, 3] and depth z [H, W] in mm at the frame's size; None after the last frame.

        Raises:
            RecordingInvalid: if a file cannot be read.
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
    """Ground truth of a recording beyond camera data; missing parts are None or empty."""

    views: tuple[RecordedView, ...] = ()
    tracks: Tracks | None = None
    true_depth: DepthFiles | None = None
    motion: MotionFiles | None = None
    behind: TissueBehindTools | None = None

    def depth_of(self, frame: Frame) -> NDArray[np.float32] | None:
        """Return the true depth at the frame's size, or the frame's own depth (may be None) if the recording has none."""
        if self.true_depth is None or frame.seq >= len(self.true_depth.files):
            return frame.depth
        depth = self.true_depth.read(frame.seq, Findings(strict=True))
        assert depth is not None
        return resize_nearest(depth, frame.width_px, frame.height_px)


def open_truth(folder: Path, frame_count: int, scale: float = 1.0) -> GroundTruth:
    """Open the ground truth of a recording's first `frame_count` frames.

    Args:
        folder: folder of the recording.
        frame_count: number of frames.
        scale: factor on the picture size of the additional cameras.

    Raises:
        RecordingInvalid: if an existing file cannot be read.
    """
    if not folder.is_dir():
        return GroundTruth()
    views = open_views(folder, frame_count, scale)
    tracks = _tracks(folder, frame_count)
    depth = _depth_files(folder, "true_depth", frame_count)
    return GroundTruth(views, tracks, depth, open_motion(folder, frame_count), open_behind(folder, frame_count))


def open_behind(folder: Path, frame_count: int) -> TissueBehindTools | None:
    """Open the tissue behind the tools for the first `frame_count` frames; None without the data.

    Raises:
        RecordingInvalid: if an existing file cannot be read.
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
    """Read an array with at least `frame_count` rows; None if the file does not exist."""
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
