"""Optional sidecars of a recording's images: masks, depth, right eye, poses, description.

A sidecar is absent if no entry has its name. An entry with its name that cannot be used is a
problem: a file in place of a folder, a dangling link, a link out of the recording, or an empty
folder. Ignoring a broken mask would let tools be learned as tissue.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.calibration import (
    POSES_FILE,
    Calibration,
    number,
    read_distortion,
    read_json,
    read_pinhole,
    read_poses,
    read_poses_bounds,
)
from gsplat_core.io.recordings.contents import FrameImages
from gsplat_core.io.recordings.frame_files import (
    SENSOR_FILE,
    DepthFiles,
    ImageFiles,
    LabelFiles,
    MaskFiles,
    ScanFiles,
    by_frame,
    check_pairing,
    check_sizes,
    read_sensor,
)
from gsplat_core.io.recordings.plain_files import (
    IMAGE_SUFFIXES,
    Findings,
    UnreadableFile,
    all_stay_inside,
    decode_plane,
    list_images,
    stays_inside,
)

RECORDING_FORMAT = "intrasplat-recording"
RECORDING_VERSION = 1
DESCRIPTION_FILE = "recording.json"
_FILES = (DESCRIPTION_FILE, POSES_FILE, "poses_bounds.npy", "cameras.json", "valid_mask.png")


class Beside:
    """Reader of the sidecar files in a recording's folder. With `folder=None` it finds none."""

    def __init__(self, folder: Path | None, images: FrameImages, findings: Findings) -> None:
        self._folder = folder
        self._images = images
        self._size = (images.width_px, images.height_px)
        self._findings = findings

    def files(self) -> tuple[Path, ...]:
        """Existing sidecars that consist of a single file."""
        found = (self._file(name) for name in _FILES)
        return tuple(path for path in found if path is not None)

    def description(self) -> dict[str, Any]:
        """Read fps, camera, depth_unit_mm and stereo_baseline_mm of `recording.json`, each optional."""
        path = self._file(DESCRIPTION_FILE)
        return (_read_description(path, self._size, self._findings) if path else None) or {}

    def poses(self) -> Calibration | None:
        """Return the calibration stored in `poses_bounds.npy`; None without the file or after a problem."""
        path = self._file("poses_bounds.npy")
        return read_poses_bounds(path, self._images.frame_count, *self._size, self._findings) if path else None

    def poses_alone(self) -> NDArray[np.float64] | None:
        """Return the world-to-camera poses [N, 4, 4] of `poses.npy`; None if it is missing or has a problem."""
        path = self._file(POSES_FILE)
        return read_poses(path, self._images.frame_count, self._findings) if path else None

    def right(self) -> ImageFiles | None:
        """Return the reader of the right eye's images; None without them or after a problem."""
        files = self._sequence("images_right", "right image")
        return ImageFiles(files, *self._size) if files else None

    def masks(self) -> MaskFiles | None:
        """Return the reader of the tool masks; None without masks or after a problem."""
        files = self._sequence("masks", "mask")
        return MaskFiles(files) if files else None

    def depth(self, unit_mm: float | None) -> DepthFiles | None:
        """Return the reader of the depth maps; None without them or after a problem. `unit_mm` is the length of one grey
        value; None if not stated, which counts as 1 mm."""
        files = self._sequence("depth", "depth map")
        if not files:
            return None
        if unit_mm is None:
            unit_mm = 1.0
            if any(path.suffix.lower() != ".npy" for path in files):
                self._findings.warn(
                    files[0].parent, "the unit of depth is not stated", "1 mm for each grey value is assumed"
                )
        return DepthFiles(files, *self._size, unit_mm)

    def labels(self) -> LabelFiles | None:
        """Return the reader of the labelled frames' classes; None without labels or after a problem."""
        found = self._some("labels", "label picture", IMAGE_SUFFIXES)
        if not found or check_sizes(list(found.values()), self._size, "label picture", self._findings) is None:
            return None
        return LabelFiles(found)

    def scans(self) -> ScanFiles | None:
        """Return the reader of the scans of a range sensor; None without scans or after a problem."""
        found = self._some("scans", "scan", frozenset({".npy"}))
        if not found:
            return None
        path = next(iter(found.values())).parent / SENSOR_FILE
        if not stays_inside(path.parent, path, self._findings):
            return None
        sensor = read_sensor(path, self._findings)
        return None if sensor is None else ScanFiles(found, sensor, self._size[0], path)

    def valid_mask(self) -> NDArray[np.uint8] | None:
        """Read the mask [H, W] of the scope's circular image, 1 inside; None without a usable file."""
        path = self._file("valid_mask.png")
        return _read_valid_mask(path, self._size, self._findings) if path else None

    def _file(self, name: str) -> Path | None:
        """Return an existing file, else None; a link that dangles or leads outside is reported as a problem."""
        path = self._there(name)
        return path if path is not None and stays_inside(path.parent, path, self._findings) else None

    def _there(self, name: str) -> Path | None:
        if self._folder is None or not os.path.lexists(self._folder / name):
            return None
        return self._folder / name

    def _some(self, name: str, what: str, suffixes: frozenset[str]) -> dict[int, Path] | None:
        """Return the files of a folder with a file for some of the frames, by index of the frame; None without
        the folder or after a problem.
        """
        folder = self._there(name)
        if folder is None or not stays_inside(folder.parent, folder, self._findings):
            return None
        if not folder.is_dir():
            self._findings.problem(
                folder, "it is not a folder", f"Give a folder with a {what} for some frames, or remove it"
            )
            return None
        files = list_images(folder, suffixes)
        if not all_stay_inside(folder.parent, files, self._findings):
            return None
        return by_frame(self._images.numbers, files, folder, what, self._findings)

    def _sequence(self, name: str, what: str) -> Sequence[Path] | None:
        """Return the files of a folder with one file per frame; None without the folder or after a problem."""
        folder = self._there(name)
        if folder is None or not stays_inside(folder.parent, folder, self._findings):
            return None
        if not folder.is_dir():
            self._findings.problem(
                folder, "it is not a folder", f"Give a folder with one {what} for each frame, or remove it"
            )
            return None
        files = list_images(folder)
        if what == "depth map" and not files:
            files = list_images(folder, frozenset({".npy"}))
        if not check_pairing(self._images.numbers, files, folder, what, self._findings):
            return None
        if not all_stay_inside(folder.parent, files, self._findings):
            return None
        return files if check_sizes(files, self._size, what, self._findings) else None


def _read_valid_mask(path: Path, size: tuple[int, int], findings: Findings) -> np.ndarray | None:
    try:
        mask = decode_plane(path)
    except UnreadableFile as error:
        findings.problem(path, str(error), "Export this mask again")
        return None
    if mask.shape != (size[1], size[0]):
        findings.problem(
            path,
            f"the mask is {list(mask.shape)}, the images are {[size[1], size[0]]}",
            "Give a grey PNG of their size",
        )
        return None
    values = np.unique(mask)
    if len(values) > 2 or values[-1] not in (0, 1, 255):
        findings.problem(
            path,
            f"it has {len(values)} different values, up to {values[-1]}",
            "Give two: 0 outside the scope's circle, 255 (or 1) inside",
        )
        return None
    if not mask.any():
        findings.problem(path, "it marks no pixel as valid", "255 means inside the scope's circle")
        return None
    return (mask != 0).astype(np.uint8)


def _read_description(path: Path, size: tuple[int, int], findings: Findings) -> dict[str, Any] | None:
    """Read the values of `Beside.description` from `recording.json`. Returns None if the file is invalid."""
    if (content := read_json(path, findings)) is None:
        return None
    if content.get("format") != RECORDING_FORMAT or content.get("version") != RECORDING_VERSION:
        findings.problem(
            path,
            f"format {content.get('format')!r:.60} version {content.get('version')!r:.20} is not known",
            f"This version reads {RECORDING_FORMAT} {RECORDING_VERSION}",
        )
        return None
    read: dict[str, Any] = {}
    for key, low, high in (("fps", 0.1, 1000), ("depth_unit_mm", 1e-6, 1e3), ("stereo_baseline_mm", 1e-3, 1e4)):
        if content.get(key) is not None:
            value = number(content[key])
            if value is None or not low <= value <= high:
                findings.problem(path, f"{key} is {content[key]!r:.40}", f"Give a number from {low:g} to {high:g}")
                return None
            read[key] = value
    if (described := content.get("camera")) is not None:
        if not isinstance(described, dict):
            findings.problem(path, f"camera is {described!r:.40}", "Give width, height, fx, fy, cx and cy in pixels")
            return None
        camera, distortion = read_pinhole(path, described, findings), read_distortion(path, described, findings)
        if camera is not None and (camera.width_px, camera.height_px) != size:
            findings.problem(
                path,
                f"its camera is {camera.width_px}x{camera.height_px}, the images are {size[0]}x{size[1]}",
                "Give the camera of these images",
            )
        read |= {"camera": camera, "distortion": distortion or ()}
    return read
