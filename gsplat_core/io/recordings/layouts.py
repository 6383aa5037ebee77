"""Recognising a recording by what lies in its folder.

| what is there                                     | layout     | read as                                               |
|---------------------------------------------------|------------|-------------------------------------------------------|
| a video, alone or in a folder                     | `video`    | beside it `masks/`, `depth/`, `poses_bounds.npy`, …   |
| `cameras.json`                                    | `cameras`  | the images it names, K, camera_to_world, `valid_mask` |
| `images/`                                         | `endonerf` | `masks/ depth/ images_right/ poses_bounds.npy`        |
| image files                                       | `images`   | a stated default camera                               |

The sidecars mean the same in every layout and each is optional. `recording.json`, which `synthesize` writes, adds what
the layouts cannot say: frame rate, camera, unit of depth, stereo baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_core.io.recordings.calibration import (
    Calibration,
    default_calibration,
    number,
    read_json,
    read_pinhole,
    read_poses_bounds,
)
from gsplat_core.io.recordings.cameras_json import read_cameras_json
from gsplat_core.io.recordings.contents import Contents, FrameImages
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.frame_files import DepthFiles, ImageFiles, MaskFiles, check_pairing, check_sizes
from gsplat_core.io.recordings.image_files import UnreadableImage, decode_image, list_images
from gsplat_core.io.recordings.video import VIDEO_SUFFIXES, open_video

RECORDING_FORMAT = "intrasplat-recording"
RECORDING_VERSION = 1
DEFAULT_FPS = 30.0
_LAYOUTS = "a video, a folder with video.mp4, with images/ (EndoNeRF), with images and cameras.json, or with images"


def inspect(path: Path, findings: Findings) -> Contents | None:
    """Recognise the layout and make every check that needs no decoding of all frames; None where there is a problem."""
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except (OSError, RuntimeError, ValueError) as error:
        findings.problem(path, f"it cannot be looked at: {error}", f"Give {_LAYOUTS}")
        return None
    if is_file:
        return _with_sidecars(path, "video", open_video(path, findings), None, findings)
    if not is_folder:
        findings.problem(path, "there is no such file or folder", f"Check the path; give {_LAYOUTS}", missing=True)
        return None
    try:
        return _inspect_folder(path, findings)
    except OSError as error:
        findings.problem(error.filename or path, f"it cannot be read: {error.strerror}", "Check its permissions")
        return None


def _inspect_folder(path: Path, findings: Findings) -> Contents | None:
    names = sorted(entry.name for entry in path.iterdir())
    videos = [path / name for name in names if Path(name).suffix.lower() in VIDEO_SUFFIXES and name[0] != "."]
    if "cameras.json" in names:
        images, calibration = read_cameras_json(path, findings) or (None, None)
        return _with_sidecars(path, "cameras", images, calibration, findings)
    if videos:
        named = [video for video in videos if video.stem == "video"]
        if len(videos) > 1 and len(named) != 1:
            found = ", ".join(video.name for video in videos[:5])
            findings.problem(path, f"it holds {len(videos)} videos ({found})", "Name the left or only one video.mp4")
            return None
        return _with_sidecars(path, "video", open_video((named or videos)[0], findings), None, findings)
    folder, layout = (path / "images", "endonerf") if "images" in names else (path, "images")
    files = list_images(folder) if folder.is_dir() else []
    if not files:
        what = f"found {', '.join(names[:8])}{', …' if len(names) > 8 else ''}" if names else "the folder is empty"
        findings.problem(folder, f"no video and no PNG or JPEG images: {what}", f"Give {_LAYOUTS}", missing=True)
        return None
    size = check_sizes(files, None, "image", findings)
    return _with_sidecars(path, layout, ImageFiles(files, *size) if size else None, None, findings)


def _with_sidecars(
    root: Path, layout: str, images: FrameImages | None, calibration: Calibration | None, findings: Findings
) -> Contents | None:
    """Add what lies beside the images."""
    if images is None:
        return None
    known = len(findings.problems)
    size = (images.width_px, images.height_px)
    folder = root if root.is_dir() else None
    described = _read_description(folder / "recording.json", size, findings) if folder else None
    described = described or {}
    other = ["recording.json", "poses_bounds.npy", "cameras.json", "valid_mask.png"] if folder else []
    right = masks = depth = valid_mask = tool_share = None
    if folder:
        if calibration is None and (folder / "poses_bounds.npy").is_file():
            calibration = read_poses_bounds(folder / "poses_bounds.npy", images.frame_count, *size, findings)
        if files := _sidecar(folder / "images_right", images, "right image", findings):
            right = ImageFiles(files, *size)
        if files := _sidecar(folder / "masks", images, "mask", findings):
            masks = MaskFiles(files)
            tool_share = masks.check_polarity(findings)
        if files := _sidecar(folder / "depth", images, "depth map", findings):
            unit_mm = described.get("depth_unit_mm")
            if unit_mm is None:
                unit_mm = 1.0
                if any(path.suffix.lower() != ".npy" for path in files):
                    findings.warn(
                        folder / "depth", "the unit of depth is not stated", "1 mm for each grey value is assumed"
                    )
            depth = DepthFiles(files, *size, unit_mm)
        if (folder / "valid_mask.png").is_file():
            valid_mask = _read_valid_mask(folder / "valid_mask.png", size, findings)
    if len(findings.problems) > known:
        return None
    if calibration is None:
        calibration = default_calibration(root, *size, findings)
    if camera := described.get("camera"):
        calibration = replace(calibration, camera=camera.with_pose(calibration.camera.world_to_camera))
    fps = described.get("fps") or images.fps
    if fps is None:
        findings.warn(root, "the frame rate is not stated", f"{DEFAULT_FPS:g} frames/s are assumed")
        fps = DEFAULT_FPS
    if images.frame_count == 1:
        findings.warn(
            root, "it has one frame: nothing can be held out and nothing moves", "Give more frames to measure"
        )
    return Contents(
        root=root,
        layout=layout,
        images=images,
        calibration=calibration,
        fps=fps,
        right=right,
        masks=masks,
        valid_mask=valid_mask,
        depth=depth,
        tool_share=tool_share,
        stereo_baseline_mm=described.get("stereo_baseline_mm"),
        other_files=tuple(folder / name for name in other if (folder / name).is_file()) if folder else (),
    )


def _sidecar(folder: Path, images: FrameImages, what: str, findings: Findings) -> Sequence[Path] | None:
    if not folder.is_dir():
        return None
    files = list_images(folder)
    if what == "depth map" and not files:
        files = list_images(folder, frozenset({".npy"}))
    if not check_pairing(images.numbers, files, folder, what, findings):
        return None
    return files if check_sizes(files, (images.width_px, images.height_px), what, findings) else None


def _read_valid_mask(path: Path, size: tuple[int, int], findings: Findings) -> np.ndarray | None:
    try:
        mask = decode_image(path, colour=False)
    except UnreadableImage as error:
        findings.problem(path, str(error), "Export this mask again")
        return None
    if mask.shape != (size[1], size[0]):
        findings.problem(
            path,
            f"the mask is {list(mask.shape)}, the images are {[size[1], size[0]]}",
            "Give a grey PNG of their size",
        )
        return None
    if not mask.any():
        findings.problem(path, "it marks no pixel as valid", "255 means inside the scope's circle")
        return None
    return (mask != 0).astype(np.uint8)


def _read_description(path: Path, size: tuple[int, int], findings: Findings) -> dict[str, Any] | None:
    """fps, camera, depth_unit_mm and stereo_baseline_mm of `recording.json`, each optional."""
    if not path.is_file() or (content := read_json(path, findings)) is None:
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
        camera = read_pinhole(path, described, findings)
        if camera is not None and (camera.width_px, camera.height_px) != size:
            findings.problem(
                path,
                f"its camera is {camera.width_px}x{camera.height_px}, the images are {size[0]}x{size[1]}",
                "Give the camera of these images",
            )
        read["camera"] = camera
    return read
