"""Image folders with `cameras.json`: pinhole K, and for each frame its file and its camera-to-world pose.

The file names come from the document, so they are held inside the recording's folder.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from gsplat_core.io.recordings.calibration import Calibration, invert_poses, number, read_json, read_pinhole
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.frame_files import ImageFiles, check_sizes
from gsplat_core.io.recordings.plain_files import UnreadableFile, check_plain, stays_inside

MAX_NAME = 512
"""Longest file name, folders included."""


def read_cameras_json(root: Path, findings: Findings) -> tuple[ImageFiles, Calibration] | None:
    """The images that `cameras.json` names, in its order, and their cameras."""
    path = root / "cameras.json"
    content = read_json(path, findings)
    if content is None:
        return None
    camera = read_pinhole(path, content, findings)
    entries = content.get("frames")
    if not isinstance(entries, list) or not entries:
        findings.problem(path, f"frames is {entries!r:.40}", 'Give a list of {"file": …, "camera_to_world": 4x4}')
        return None
    if camera is None:
        return None
    files: list[Path] = []
    poses: list[Any] = []
    for index, entry in enumerate(entries):
        entry = entry if isinstance(entry, dict) else {}
        file = _inside(root, entry.get("file"), path, index, findings)
        pose = _pose(entry.get("camera_to_world"), path, index, findings)
        if file is None or pose is None:
            return None
        files.append(file)
        poses.append(pose)
    size = (camera.width_px, camera.height_px)
    world_to_camera = invert_poses(np.stack(poses)[:, :3], path, findings)
    if world_to_camera is None or check_sizes(files, size, "image", findings) is None:
        return None
    fps = stated = content.get("fps", content.get("fps_assumed"))
    if stated is not None:
        fps = number(stated)
        if fps is None or not 0.1 <= fps <= 1000:
            findings.problem(path, f"the frame rate is {stated!r:.40}", "Give frames per second from 0.1 to 1000")
            return None
    calibration = Calibration(camera.with_pose(world_to_camera[0]), world_to_camera, path.name)
    return ImageFiles(files, *size, fps), calibration


def _pose(value: object, path: Path, index: int, findings: Findings) -> np.ndarray | None:
    try:
        pose = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or pose[3].tolist() != [0, 0, 0, 1]:
        findings.problem(
            path,
            f"camera_to_world of frame {index} is {value!r:.60}",
            "Give 4 rows of 4 finite numbers, the last of them 0 0 0 1",
        )
        return None
    return pose


def _inside(root: Path, name: object, path: Path, index: int, findings: Findings) -> Path | None:
    """The file that a document names, held inside the folder: no absolute path, no `..`, no link that leads out."""
    relative = isinstance(name, str) and 0 < len(name) <= MAX_NAME and "\0" not in name
    if relative:
        posix, windows = PurePosixPath(str(name)), PureWindowsPath(str(name))
        relative = not posix.is_absolute() and not windows.anchor and ".." not in (*posix.parts, *windows.parts)
    if not relative:
        findings.problem(
            path, f"the file of frame {index} is {name!r:.80}", "Give a path inside the recording's folder"
        )
        return None
    file = root / str(name)
    try:
        missing = not os.path.lexists(file)
        check_plain(file)
    except (UnreadableFile, ValueError) as error:
        findings.problem(
            file,
            f"frame {index} cannot be read: {error}",
            "Export it again, or drop it from cameras.json",
            missing=missing,
        )
        return None
    return file if stays_inside(root, file, findings) else None
