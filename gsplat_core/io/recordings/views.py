"""Further cameras of a recording, which training never gets: for measuring how a model looks from where nobody looked.

    views.json
      {"format": "intrasplat-views", "version": 1, "depth_unit_mm": 0.01,
       "views": [{"name": "third", "folder": "views/third", "camera": {"width": 320, ...}, "left_to_view": [[...], ...]}]}
    views/third/images/   one picture for each frame of the recording
    views/third/masks/    optional, 255 = tool
    views/third/depth/    optional, 16 bit PNG in `depth_unit_mm`, or .npy in mm

`left_to_view` leads from the coordinates of the recording's own camera at a frame to those of the view at the same frame: the cameras are
fixed to each other. Nothing here is part of what training reads, nor of a recording's digest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.calibration import number, read_json, read_pinhole
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.frame_files import DepthFiles, ImageFiles, MaskFiles, check_sizes, resized_frame
from gsplat_core.io.recordings.image_files import list_images
from gsplat_core.io.recordings.plain_files import all_stay_inside, stays_inside
from gsplat_core.io.recordings.sidecars import Beside
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

VIEWS_FILE = "views.json"
VIEWS_FORMAT = "intrasplat-views"
VIEWS_VERSION = 1
MOST_VIEWS = 16
"""Cameras beside the recording's own."""


@dataclass(frozen=True)
class RecordedView:
    """A camera that is fixed to the recording's own one, and what it saw."""

    name: str
    camera: Camera
    """Its pose leads from the coordinates of the recording's own camera to its own, as `Frame.right_camera`'s does."""
    files: tuple[Path, ...]
    masks: MaskFiles | None
    depth: DepthFiles | None

    def read(self, index: int) -> Frame:
        """What it saw at a frame of the recording, at `camera`'s size: image, and mask and depth where they are known.

        Raises RecordingInvalid.
        """
        findings = Findings(strict=True)
        picture = next(ImageFiles(self.files[index : index + 1], 0, 0).frames(findings))
        assert picture is not None  # strict findings have raised
        frame = Frame(
            seq=index,
            pts_ns=0,
            image=picture.image,
            mask=None if self.masks is None else self.masks.read(index, findings),
            depth=None if self.depth is None else self.depth.read(index, findings),
            depth_origin=None if self.depth is None else DepthOrigin.MEASURED,
        )
        return resized_frame(frame, self.camera.width_px, self.camera.height_px)


def open_views(folder: Path, frame_count: int, scale: float = 1.0) -> tuple[RecordedView, ...]:
    """The further cameras of a recording's folder, seen at a scale; none where it has no `views.json`. Raises RecordingInvalid for what cannot
    be read, or has too few pictures for `frame_count` frames."""
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
